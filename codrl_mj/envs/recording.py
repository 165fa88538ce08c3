"""What an environment shows of an episode besides what Gymnasium's interface has: its `recorder`."""

from typing import Any, Protocol

import numpy as np

from codrl_mj.physics import signal_names, trace_names


class Recorder(Protocol):
    """Reads an environment between its steps: `env.get_wrapper_attr("recorder")`, from which on it may step slower."""

    step_duration: float
    """Environment step [s], known once a step was taken."""
    signal_names: tuple[str, ...]
    """Of the actuators' signals in `info`."""
    trace_names: tuple[str, ...]
    """Of the columns of `trace`, as `codrl_mj.physics.trace_names` has them."""
    command: str
    """What the agent commands."""
    motors: tuple[str, ...]
    """Names of the motors."""
    actuator: Any
    """What the present episode runs on; with several motors a tuple of them."""

    def state(self) -> np.ndarray:
        """The mechanical state, shape (k,)."""

    def speeds(self) -> np.ndarray:
        """Velocities at the motors' side of the model's gears [m/s or rad/s], shape (motors,)."""

    def trace(self) -> np.ndarray:
        """What the motors did in each integration step of the last step, shape (n, motors, columns)."""


class PhysicsRecorder:
    """The recorder of a task's environment."""

    def __init__(self, env: Any) -> None:
        """Look at an `ActuatedEnv`."""
        self._env, setup = env, env.setup
        self.step_duration = setup.task.step_duration
        self.signal_names, self.trace_names = signal_names(setup.family), trace_names(setup.family)
        self.command, self.motors = setup.commands.name, setup.task.motors

    @property
    def actuator(self) -> Any:
        """See `Recorder`."""
        return self._env.actuator

    def state(self) -> np.ndarray:
        """See `Recorder`."""
        state: np.ndarray = self._env.physics.state
        return state

    def speeds(self) -> np.ndarray:
        """See `Recorder`."""
        return self.state()[list(self._env.task.speeds)]

    def trace(self) -> np.ndarray:
        """See `Recorder`."""
        trace: np.ndarray = self._env.physics.trace.copy()
        return trace
