"""Looks at each integration step of anybody's environment: its `recorder`, as our own environments are theirs."""

from typing import Any

import mujoco
import numpy as np

from codrl_mj.envs.motors import ActuatorBank
from codrl_mj.envs.setup import alone


class SubstepRecorder:
    """Sees each integration step of an environment that calls `mujoco.mj_step`; of others the end of their steps.

    What it has is what an `ActuatedEnv` has by the same names, states and speeds being the model's.
    """

    def __init__(
        self, motors: ActuatorBank, command: str, step_duration: float | None = None
    ) -> None:
        """Look at their simulation, in which the agent gives a command; steps take that long [s], if it is known."""
        self._motors, self._data, model = motors, motors.data, motors.data.model
        self._rows: list[np.ndarray] = []
        self._outputs = model.actuator_outadr[list(motors.present)]
        self._moments = np.empty((model.nout, model.nv))
        self.step_duration = float(step_duration or model.opt.timestep)
        """Duration of the last environment step [s]; before the first the environment's `dt`, or else the model's."""
        self.signal_names, self.trace_names = (
            tuple(motors.signals()),
            (*motors.readout.names, "speed"),
        )
        self.command, self.motor_names = command, motors.names

    @property
    def actuator(self) -> Any:
        """What the present episode runs on; with several motors a tuple of them."""
        return alone(tuple(self._motors.present.values()))

    @property
    def state(self) -> np.ndarray:
        """Positions and speeds of the model, shape (k,)."""
        return np.concatenate([self._data.qpos, self._data.qvel])

    @property
    def trace(self) -> np.ndarray:
        """What the motors did in each integration step of the last step, shape (n, motors, columns)."""
        return np.array(self._rows)

    @property
    def speeds(self) -> np.ndarray:
        """Speeds of the shafts [m/s or rad/s]; the engine's own are those at the beginning of a step."""
        data = self._data
        mujoco.mju_sparse2dense(
            self._moments,
            data.actuator_moment,
            data.moment_rownnz,
            data.moment_rowadr,
            data.moment_colind,
        )
        return self._moments[self._outputs] @ data.qvel

    def step(self, env: Any, action: Any) -> Any:
        """Take a step of the environment, and record what it does in it; not in two threads at once."""
        self._rows, plain, second_half, began = [], mujoco.mj_step, mujoco.mj_step2, self._data.time

        def each(model: mujoco.MjModel, data: mujoco.MjData, nstep: int = 1) -> None:
            if data is not self._data:
                plain(model, data, nstep)
                return
            for _ in range(nstep):
                plain(model, data)
                self._row()

        def halves(model: mujoco.MjModel, data: mujoco.MjData) -> None:
            second_half(model, data)
            if data is self._data:
                self._row()

        # dm_control's physics takes the first of its integration steps by mj_step2 and mj_step1.
        mujoco.mj_step, mujoco.mj_step2 = each, halves  # type: ignore[assignment]
        try:
            outcome = env.step(action)
        finally:
            mujoco.mj_step, mujoco.mj_step2 = plain, second_half
        if self._rows:
            self.step_duration = len(self._rows) * float(self._data.model.opt.timestep)
        else:
            self.step_duration = float(self._data.time - began)
            self._row()
        return outcome

    def _row(self) -> None:
        self._rows.append(np.column_stack([*self._motors.readout.table(self._data), self.speeds]))
