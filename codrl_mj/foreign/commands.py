"""From an agent's action to the controls of somebody else's environment."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from gymnasium import spaces

from codrl_mj.actuators import ActuatorModel, Command
from codrl_mj.actuators.noise import LARGEST_KEY
from codrl_mj.disturbances import Disturbances
from codrl_mj.physics.disturber import Disturber
from codrl_mj.specs import ON_JOINT


def command_of(actuator: ActuatorModel, name: str, pattern: str) -> Command | None:
    """What an action means to an actuator; None where it is the environment's own, whose force is desired.

    Raises:
        ValueError: the actuator takes no such command.
    """
    if name == "force":
        return None
    known = actuator.commands()
    if name not in known:
        raise ValueError(
            f"action = {name!r}: the {actuator.family or type(actuator).__name__} actuator of {pattern!r} takes "
            f"{', '.join(['force', *known])}; choose one of them, or another actuator"
        )
    return known[name]


class Commands:
    """Actions in the units of the motors' commands, with their limits; actions of other actuators are as they were."""

    def __init__(self, model: mujoco.MjModel, space: spaces.Space, commands: Mapping[int, Command]) -> None:
        """Let the motors' controls reach as far as the commands do.

        Args:
            model: the environment's; its `actuator_ctrlrange` is changed.
            space: the environment's own actions.
            commands: index of the actuator -> what an action means to it.

        Raises:
            ValueError: actions are not the model's controls, an actuator is not a plain motor, or has no limit.
        """
        if not isinstance(space, spaces.Box) or space.shape != (model.nu,):
            raise ValueError(
                f"action: the environment's actions are {space}, not the {model.nu} controls of its model; use "
                "action='force', its own"
            )
        self._scales = np.ones(model.nu)
        low, high = space.low.astype(np.float64), space.high.astype(np.float64)
        for index, command in commands.items():
            control, gain = model.actuator_ctrladr[index], plain_gain(model, index)
            name = model.actuator(index).name or f"actuator {index}"
            if gain is None:
                raise ValueError(
                    f"{name}: is no plain motor, whose force is its control times a gain: use action='force', the "
                    "environment's own"
                )
            actuator, torque = command.actuator, command.torque_per_unit
            arm = actuator.arm_radius
            self._scales[control] = scale = torque * arm if actuator.MOTION else torque / (arm * gain)
            limit = command.limit
            if limit is None and model.actuator_ctrllimited[control]:
                limit = np.abs(model.actuator_ctrlrange[control]).max() / abs(scale)
            if limit is None or not np.isfinite(limit):
                raise ValueError(
                    f"{name}: a command [{command.unit}] needs a limit, and neither the motor nor the environment's "
                    "control has one: give the motor's controller one"
                )
            low[control], high[control] = -limit, limit
            model.actuator_ctrllimited[control] = True
            model.actuator_ctrlrange[control] = -limit * abs(scale), limit * abs(scale)
        self.action_space = spaces.Box(low.astype(space.dtype), high.astype(space.dtype), dtype=space.dtype.type)
        """Per motor +- the largest command."""

    def controls(self, action: np.ndarray) -> np.ndarray:
        """The environment's own action for one of `action_space`, float64."""
        if np.shape(action) != self.action_space.shape:
            raise ValueError(f"action has shape {np.shape(action)}: must be {self.action_space.shape}")
        return np.asarray(action, dtype=np.float64) * self._scales


class CommandsWay:
    """Disturbances of the motors, once an environment step, which has the place of the integration step."""

    def __init__(
        self,
        data: mujoco.MjData,
        motors: Sequence[int],
        actions: spaces.Space,
        disturbances: Disturbances,
        step_duration: float,
    ) -> None:
        """Take the units: of a plain motor its force [N or N*m] before the gear, of others the control's own.

        Args:
            data: the environment's simulation.
            motors: indices of the motors' actuators, n of them.
            actions: the environment's own action space.
            disturbances: what happens to their commands, and to their joints.
            step_duration: environment step [s].

        Raises:
            ValueError: actions are not the model's controls; or there are load pulses, and a motor drives no joint.
        """
        model, indices = data.model, list(motors)
        if not isinstance(actions, spaces.Box) or actions.shape != (model.nu,):
            raise ValueError(
                f"disturbances: the environment's actions are {actions}, not the {model.nu} controls of its model, "
                "which are what can be disturbed"
            )
        self._data, self._pulses = data, disturbances.random
        self._controls = controls = model.actuator_ctrladr[indices]
        limited = model.actuator_ctrllimited[controls].astype(bool)
        largest = np.where(limited, np.abs(model.actuator_ctrlrange[controls]).max(axis=1), np.inf)
        self._gains = np.array([plain_gain(model, index) or 1.0 for index in indices])
        self._disturber = Disturber(disturbances, step_duration, largest * np.abs(self._gains), 1)
        self._dofs = [_dof(model, index) for index in indices] if self._pulses else []

    @property
    def memory(self) -> np.ndarray:
        """The commands on their way and the pulses to come, a live array."""
        return self._disturber.memory

    def begin(self, generator: np.random.Generator) -> None:
        """Forget everything at the start of an episode; pulses have random numbers of their own in each."""
        key = np.floor(generator.random() * LARGEST_KEY) if self._pulses else 0.0
        self._disturber.reset(np.zeros(1, dtype=int), key)
        self._data.qfrc_applied[self._dofs] = 0.0

    def controls(self, action: np.ndarray) -> np.ndarray:
        """What arrives of an action in this step, float64; the loads of the step go to the joints."""
        arrived = np.array(action, dtype=np.float64)
        wanted = arrived[self._controls] * self._gains
        arrived[self._controls] = self._disturber.commands(wanted[np.newaxis])[0] / self._gains
        if self._pulses:
            self._data.qfrc_applied[self._dofs] = 0.0
            np.add.at(self._data.qfrc_applied, self._dofs, self._disturber.loads()[0])
        return arrived


def _dof(model: mujoco.MjModel, index: int) -> int:
    """The degree of freedom that a motor drives.

    Raises:
        ValueError: it drives no joint.
    """
    if mujoco.mjtTrn(model.actuator_trntype[index]) not in ON_JOINT:
        raise ValueError(
            f"disturbances.pulse_force: {model.actuator(index).name or f'actuator {index}'} drives no joint on which a "
            "load could act; give only command_delay, command_quantum and command_rate"
        )
    return int(model.jnt_dofadr[model.actuator_trnid[index, 0]])


def plain_gain(model: mujoco.MjModel, index: int) -> float | None:
    """The gain of an actuator whose force is gain*control; None where it is more than that."""
    kinds = (model.actuator_gaintype[index], model.actuator_biastype[index], model.actuator_dyntype[index])
    plain = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE)
    gain = float(model.actuator_gainprm[index, 0])
    return gain if kinds == plain and gain != 0.0 else None
