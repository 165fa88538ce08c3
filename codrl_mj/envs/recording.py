"""Recorder of every integration step of a third-party environment."""

from typing import SupportsFloat

import mujoco
import numpy as np

from codrl_mj.actuators import ActuatorModel
from codrl_mj.boundary import Action, Info, Observation
from codrl_mj.envs.config import Env
from codrl_mj.envs.model_bank import ModelBank
from codrl_mj.envs.setup import unwrap_single


class SubstepRecorder:
    """Records every integration step of an environment that calls `mujoco.mj_step`.

    In other environments it records the end of each environment step. Its attributes are named as
    in `ActuatedEnv`; states and speeds are those of the model.
    """

    def __init__(self, motors: ModelBank, command: str, step_duration: float | None = None) -> None:
        """Attach to the simulation of the motors.

        Args:
            motors: the motors.
            command: the agent's command.
            step_duration: duration of an environment step [s]; None if unknown.
        """
        self._motors, self._data, model = motors, motors.data, motors.data.model
        self._rows: list[np.ndarray] = []
        self._outputs = model.actuator_outadr[list(motors.motors)]
        self._moments = np.empty((model.nout, model.nv))
        self.step_duration = float(step_duration or model.opt.timestep)
        """Duration of the last environment step [s]; initially `dt`, or the model's time step."""
        self.signal_names, self.trace_names = (
            motors.signal_names,
            (*motors.readout.names, "speed"),
        )
        self.command, self.motor_names = command, motors.names

    @property
    def actuator(self) -> ActuatorModel | tuple[ActuatorModel, ...]:
        """Actuator of the present episode; for several motors a tuple."""
        return unwrap_single(tuple(self._motors.motors.values()))

    @property
    def state(self) -> np.ndarray:
        """Positions and speeds of the model, shape (k,)."""
        return np.concatenate([self._data.qpos, self._data.qvel])

    @property
    def trace(self) -> np.ndarray:
        """Signals after each integration step of the last step, shape (n, motors, columns)."""
        return np.array(self._rows)

    @property
    def speeds(self) -> np.ndarray:
        """Speeds of the shafts [m/s or rad/s], shape (motors,)."""
        # MuJoCo's `actuator_velocity` is from the beginning of the integration step.
        data = self._data
        mujoco.mju_sparse2dense(
            self._moments,
            data.actuator_moment,
            data.moment_rownnz,
            data.moment_rowadr,
            data.moment_colind,
        )
        speeds: np.ndarray = self._moments[self._outputs] @ data.qvel
        return speeds

    def step(self, env: Env, action: Action) -> tuple[Observation, SupportsFloat, bool, bool, Info]:
        """Take an environment step and record its integration steps; not thread-safe."""
        self._rows, original_step, original_step2, start_time = (
            [],
            mujoco.mj_step,
            mujoco.mj_step2,
            self._data.time,
        )

        def recording_step(model: mujoco.MjModel, data: mujoco.MjData, nstep: int = 1) -> None:
            if data is not self._data:
                original_step(model, data, nstep)
                return
            for _ in range(nstep):
                original_step(model, data)
                self._append_row()

        def recording_step2(model: mujoco.MjModel, data: mujoco.MjData) -> None:
            original_step2(model, data)
            if data is self._data:
                self._append_row()

        # Environments call `mujoco.mj_step` in their own code, often several times in a step, and
        # MuJoCo has no callback after an integration step. So the function itself is replaced, for
        # as long as this step takes.
        # dm_control's physics takes the first integration step of each environment step as mj_step2
        # and mj_step1, so recording mj_step alone would miss it.
        mujoco.mj_step, mujoco.mj_step2 = recording_step, recording_step2
        try:
            outcome = env.step(action)
        finally:
            mujoco.mj_step, mujoco.mj_step2 = original_step, original_step2
        if self._rows:
            self.step_duration = len(self._rows) * float(self._data.model.opt.timestep)
        else:
            self.step_duration = float(self._data.time - start_time)
            self._append_row()
        return outcome

    def _append_row(self) -> None:
        self._rows.append(np.column_stack([*self._motors.readout.table(self._data), self.speeds]))
