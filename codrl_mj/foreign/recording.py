"""What a motorised environment shows of its episodes, integration step by integration step."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel
from codrl_mj.engine.reading import Readout
from codrl_mj.specs import names_of


class MotorsRecorder:
    """The `codrl_mj.envs.recording.Recorder` of a motorised environment.

    It sees each integration step of environments that call `mujoco.mj_step`; of others the end of their steps.
    """

    def __init__(
        self, data: mujoco.MjData, readout: Readout, command: str, motors: Callable[[], Mapping[int, ActuatorModel]]
    ) -> None:
        """Look at a simulation.

        Args:
            data: the simulation.
            readout: of its model.
            command: what the agent commands.
            motors: the motors of the present episode, by the index of the actuator.
        """
        model = data.model
        self._data, self._readout, self._motors = data, readout, motors
        self._rows: list[np.ndarray] = []
        self.command, self.motors = command, tuple(motor_names(model, readout.motors))
        self._outputs = model.actuator_outadr[list(readout.motors)]
        self._moments = np.empty((model.nout, model.nv))
        names = readout.names
        self.trace_names = (*names, "speed")
        self.signal_names = (*(name for name in names if name != "saturated"), "saturated")
        self.step_duration = float(model.opt.timestep)

    @property
    def actuator(self) -> Any:
        """See `Recorder`."""
        found = tuple(self._motors().values())
        return found[0] if len(found) == 1 else found

    def state(self) -> np.ndarray:
        """Positions and velocities, `qpos` and `qvel`."""
        return np.concatenate([self._data.qpos, self._data.qvel])

    def speeds(self) -> np.ndarray:
        """See `Recorder`; the engine's own are those at the beginning of a step."""
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
            self.step_duration = len(self._rows) * float(self._data.model.opt.timestep)
        else:
            self.step_duration = float(self._data.time - began)
            self._row()

    def _row(self) -> None:
        self._rows.append(np.column_stack([*self._readout.table(self._data), self.speeds()]))

    def trace(self) -> np.ndarray:
        """See `Recorder`."""
        return np.array(self._rows)


def motor_names(model: mujoco.MjModel, motors: Iterable[int]) -> list[str]:
    """What motors are called: as their actuators, or else as what these drive; by their indices where that says less.

    Args:
        model: the model.
        motors: indices of actuators.
    """
    every = [own[0] if own else "" for own in names_of(model)]
    return [every[index] if every.count(every[index]) == 1 and every[index] else str(index) for index in motors]
