"""What a rig did beside what the simulation does under the same commands, in short windows."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.deploy.contract import Interface
from codrl_mj.deploy.log import read_rows
from codrl_mj.envs.config import EnvConfig

WINDOW, ROWS = 0.5, 10
"""Time [s] after which the simulation begins again at what was observed, and after how many rows at least."""
_STARTS = 8  # further states from which the one is searched that an observation tells


@dataclasses.dataclass(frozen=True)
class RigComparison:
    """Observations of a log of n rows and of the simulation under its commands, which begins anew at some of them."""

    names: list[str]
    """What is observed."""
    units: list[str | None]
    """Of each of them."""
    time: np.ndarray
    """[s], shape (n,)."""
    logged: np.ndarray
    """Shape (n, k)."""
    simulated: np.ndarray
    """Shape (n, k)."""
    starts: np.ndarray
    """Rows at which the simulation begins at what was observed, shape (windows,)."""

    @property
    def errors(self) -> np.ndarray:
        """Root of the mean square of simulated less logged, over all windows, shape (k,)."""
        return np.sqrt(((self.simulated - self.logged) ** 2).mean(axis=0))

    @property
    def moved(self) -> np.ndarray:
        """The same of a guess that nothing changes within a window, shape (k,), to hold the errors against."""
        held = self.logged[
            self.starts[np.searchsorted(self.starts, np.arange(len(self.time)), "right") - 1]
        ]
        return np.sqrt(((held - self.logged) ** 2).mean(axis=0))


def compare(
    env: EnvConfig, path: Path, window: float | None = None, actuator: Any = None
) -> RigComparison:
    """Simulate the commands of a log, and hold what is observed then against what was observed on the rig.

    The simulation begins at the first row's observation and again after each window; its motors go
    on as they are, as the commands before have left them. What is drawn in the environment is not
    drawn here. Another motor gets the current that a command stood for in the training, as on the
    rig: a controller knows no other torque constant.

    Args:
        env: the environment that the policy was trained in.
        path: the log, as `codrl_mj.deploy.log.read_rows` reads it.
        window: time [s] from one beginning to the next; None: half a second, and at least ten rows
            of the log.
        actuator: what the simulation has for motors, by name, file or object; None: those of the
            training.

    Raises:
        FileNotFoundError: there is no such log.
        ValueError: the log cannot be read, or is of another environment; `window` is shorter than
            two rows; or the environment's state does not follow from what is observed.
    """
    env = dataclasses.replace(env, randomize=None)
    interface = Interface.between(env)
    time, observed, commands = read_rows(interface, path)
    length = (
        max(round(WINDOW * interface.rate), ROWS)
        if window is None
        else round(window * interface.rate)
    )
    if window is not None and length < 2:
        raise ValueError(
            f"window = {window:g} s: must be at least {2 / interface.rate:g} s, two rows of the log"
        )
    starts = np.arange(0, len(time), length)
    tried = (
        env
        if actuator is None
        else dataclasses.replace(env, actuator=dict.fromkeys(env.actuators_by_name, actuator))
    )
    if env.action == "force" and interface.levels is None:
        # force at the joint for an ampere; 0 of what has no motor, whose commands stay as they are
        constants = [
            [
                one.motor.torque_constant / one.arm_radius if hasattr(one, "motor") else 0.0
                for one in side
            ]
            for side in (tried.actuators, env.actuators)
        ]
        commands = commands * [
            new / old if new and old else 1.0 for new, old in zip(*constants, strict=True)
        ]
        most = np.array(
            [one["most"] for one in interface.actions], dtype=float
        )  # None is nan: nothing is above it
        if beyond := int((np.abs(commands) > most * (1.0 + 1e-6)).any(axis=1).sum()):
            raise ValueError(
                f"{path}: in {beyond} rows the command, as this motor gives it, is beyond the"
                f" simulation's bound, {most.tolist()}: simulate the motor of the training, or"
                " convert the log"
            )
    simulated, actions = [], interface.actions_of(commands)
    with contextlib.closing(tried.make()) as made:
        moved: Any = made.unwrapped
        if (task := getattr(moved, "task", None)) is None:
            raise ValueError(
                f"{interface.task}: only a task's state can be set to what was observed: must be a"
                " task"
            )
        observation, _ = moved.reset(seed=0)
        for row, action in enumerate(actions):
            if row in starts:
                moved.state = _state_of(task, observed[row], moved.state)
                observation = observed[row]
            simulated.append(observation)
            observation = moved.step(action)[0]
    names, units = ([one[key] for one in interface.observations] for key in ("name", "unit"))
    return RigComparison(names, units, time, observed, np.array(simulated), starts)


def _state_of(task: Any, observed: np.ndarray, near: np.ndarray) -> np.ndarray:
    """The task's state at which it observes that, of several the one near another (n,)."""
    from scipy.optimize import least_squares

    seen = observed[: len(task.observation_names)]  # behind are the motors'

    def off(state: np.ndarray) -> np.ndarray:
        return np.array(task.observation(tuple(state)), dtype=float) - seen

    random, found = np.random.default_rng(0), least_squares(off, near)
    for _ in range(_STARTS):
        if found.cost < 1e-9:
            break
        other = least_squares(off, near + random.uniform(-np.pi, np.pi, len(near)))
        found = other if other.cost < found.cost else found
    if np.linalg.matrix_rank(found.jac, tol=1e-6) < len(near):
        raise ValueError(
            f"{task.name}: its state does not follow from its observation: the rig cannot be"
            " simulated"
        )
    return np.asarray(found.x)
