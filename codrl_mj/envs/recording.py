"""What an environment shows of an episode besides what Gymnasium's interface has: its `recorder`."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np

from codrl_mj.envs.motors import Motors
from codrl_mj.envs.setup import alone


@dataclasses.dataclass(frozen=True)
class Recorder:
    """Reads an environment between its steps: `env.get_wrapper_attr("recorder")`, from which on it may step slower."""

    signal_names: tuple[str, ...]
    """Of the actuators' signals in `info`."""
    trace_names: tuple[str, ...]
    """Of the columns of `trace`, as `codrl_mj.physics.trace_names` has them."""
    command: str
    """What the agent commands."""
    motors: tuple[str, ...]
    """Names of the motors."""
    present: Callable[[], Any]
    """What the present episode runs on; with several motors a tuple of them."""
    state: Callable[[], np.ndarray]
    """The mechanical state, shape (k,)."""
    speeds: Callable[[], np.ndarray]
    """Velocities at the motors' side of the model's gears [m/s or rad/s], shape (motors,)."""
    trace: Callable[[], np.ndarray]
    """What the motors did in each integration step of the last step, shape (n, motors, columns)."""
    duration: Callable[[], float]
    """Environment step [s], known once a step was taken."""

    @property
    def step_duration(self) -> float:
        """Environment step [s], known once a step was taken."""
        return self.duration()

    @property
    def actuator(self) -> Any:
        """What the present episode runs on; with several motors a tuple of them."""
        return self.present()


class StepWatch:
    """Sees each integration step of an environment that calls `mujoco.mj_step`; of others the end of their steps."""

    def __init__(self, motors: Motors) -> None:
        """Look at their simulation."""
        self._motors, self._data, model = motors, motors.data, motors.data.model
        self._rows: list[np.ndarray] = []
        self._duration = float(model.opt.timestep)
        self._outputs = model.actuator_outadr[list(motors.present)]
        self._moments = np.empty((model.nout, model.nv))

    def recorder(self, command: str) -> Recorder:
        """What it sees, where the agent gives a command."""
        data, names = self._data, self._motors.readout.names
        return Recorder(
            (*(name for name in names if name != "saturated"), "saturated"),
            (*names, "speed"),
            command,
            self._motors.names,
            present=lambda: alone(tuple(self._motors.present.values())),
            state=lambda: np.concatenate([data.qpos, data.qvel]),
            speeds=self._speeds,
            trace=lambda: np.array(self._rows),
            duration=lambda: self._duration,
        )

    def _speeds(self) -> np.ndarray:
        """Speeds of the shafts; the engine's own are those at the beginning of a step."""
        data = self._data
        mujoco.mju_sparse2dense(
            self._moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )
        return self._moments[self._outputs] @ data.qvel

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        """Record what the environment does in the block, one step of it; not in two threads at once."""
        self._rows, plain, began = [], mujoco.mj_step, self._data.time

        def each(model: mujoco.MjModel, data: mujoco.MjData, nstep: int = 1) -> None:
            if data is not self._data:
                plain(model, data, nstep)
                return
            for _ in range(nstep):
                plain(model, data)
                self._row()

        mujoco.mj_step = each  # type: ignore[assignment]
        try:
            yield
        finally:
            mujoco.mj_step = plain
        if self._rows:
            self._duration = len(self._rows) * float(self._data.model.opt.timestep)
        else:
            self._duration = float(self._data.time - began)
            self._row()

    def _row(self) -> None:
        self._rows.append(np.column_stack([*self._motors.readout.table(self._data), self._speeds()]))
