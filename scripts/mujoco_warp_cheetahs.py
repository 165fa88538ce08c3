"""HalfCheetahs with motors in mujoco_warp, for the benchmark and the check of a GPU."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import mujoco_warp
import numpy as np
import warp as wp

from codrl_mj.actuators import ActuatorModel, resolve
from codrl_mj.arrays import prepare_model
from codrl_mj.arrays.c_code import Real
from codrl_mj.arrays.mujoco_warp import attach_motors

MOTOR = "maxon-ec45-flat-50w"
CHEETAH = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "half_cheetah.xml"
TIMESTEP = 0.002
_NUM_CONTROLS = 8

wp.config.quiet = True


def cheetah_motors() -> dict[str, ActuatorModel]:
    """Return six motors of two kinds for HalfCheetah, by patterns of its actuators."""
    rear = resolve(MOTOR, None, "HalfCheetah").replaced(
        {"motor.gear_ratio": 4.0, "motor.gear_efficiency": 0.9, "controller.max_current": 6.0}
    )
    return {"b.*": rear, "f.*": rear.replaced({"motor.gear_ratio": 2.0})}


class Cheetahs:
    """HalfCheetahs under random controls, each in a world."""

    def __init__(
        self,
        num_worlds: int,
        device: str,
        *,
        actuators: Mapping[str, ActuatorModel] | None = None,
        with_motors: bool = True,
        real: Real = "double",
    ) -> None:
        """Create the simulation.

        Args:
            num_worlds: number of worlds.
            device: device of Warp.
            actuators: motors by pattern; None: `cheetah_motors`.
            with_motors: False to leave the motors out, but not their inertia and friction.
            real: precision of the motors.
        """
        spec = mujoco.MjSpec.from_file(str(CHEETAH))
        spec.option.timestep = TIMESTEP
        patterns = cheetah_motors() if actuators is None else actuators
        robot = prepare_model(spec, patterns)
        compiled = robot.spec.compile()
        generator = np.random.default_rng(0)
        self._starts = np.zeros((num_worlds, compiled.nq), np.float32)
        self._starts[:, 3:] = generator.uniform(-0.1, 0.1, (num_worlds, compiled.nq - 3))
        controls = generator.uniform(-1.0, 1.0, (_NUM_CONTROLS, num_worlds, compiled.nu))
        # mujoco_warp is not followed by the type checker.
        self.model: Any
        self.data: Any
        with wp.ScopedDevice(device):
            self.model = mujoco_warp.put_model(compiled)
            self.data = mujoco_warp.make_data(compiled, nworld=num_worlds)
            self._controls = [wp.array(rows.astype(np.float32)) for rows in controls]
            if with_motors and patterns:
                attach_motors(robot, self.model, self.data, real=real)
        self.reset()

    def reset(self) -> None:
        """Put all cheetahs into their initial positions."""
        mujoco_warp.reset_data(self.model, self.data)
        self.data.qpos.assign(self._starts)
        self.change_controls(0)

    def change_controls(self, number: int) -> None:
        """Use one of a few sets of random controls."""
        wp.copy(self.data.ctrl, self._controls[number % _NUM_CONTROLS])

    def step(self) -> None:
        """Advance all worlds by a step."""
        mujoco_warp.step(self.model, self.data)
