"""Comparison of a rig's log with the simulation under the same commands, in short windows."""

import contextlib
import dataclasses
from pathlib import Path
from typing import cast

import numpy as np

from codrl_mj.deploy.contract import Interface
from codrl_mj.deploy.log import read_rows
from codrl_mj.envs import ActuatedEnv
from codrl_mj.envs.config import EnvConfig
from codrl_mj.tasks import Task

WINDOW, MIN_ROWS = 0.5, 10
"""Default duration [s] and smallest number of rows of a window.

After each window the simulation restarts at the observed state.
"""
_STARTS = 8
"""Number of further initial guesses in the search for the state of an observation."""


@dataclasses.dataclass(frozen=True)
class RigComparison:
    """Observations of a log with n rows, and of the simulation under the log's commands."""

    names: list[str]
    """Names of the observations."""
    units: list[str | None]
    """Unit of each observation."""
    time: np.ndarray
    """Time [s], shape (n,)."""
    logged: np.ndarray
    """Observations in the log, shape (n, k)."""
    simulated: np.ndarray
    """Observations in the simulation, shape (n, k)."""
    starts: np.ndarray
    """Rows at which the simulation restarts at the observed state, shape (windows,)."""

    @property
    def errors(self) -> np.ndarray:
        """Root mean square of simulated minus logged, over all windows, shape (k,)."""
        errors: np.ndarray = np.sqrt(((self.simulated - self.logged) ** 2).mean(axis=0))
        return errors

    @property
    def baseline_errors(self) -> np.ndarray:
        """Errors of a baseline that holds the first observation of each window, shape (k,)."""
        held = self.logged[
            self.starts[np.searchsorted(self.starts, np.arange(len(self.time)), "right") - 1]
        ]
        errors: np.ndarray = np.sqrt(((held - self.logged) ** 2).mean(axis=0))
        return errors


def compare(
    env: EnvConfig, path: Path, window: float | None = None, actuator: object = None
) -> RigComparison:
    """Simulate the commands of a log and compare the observations with those in the log.

    The simulation starts at the state of the first row's observation and restarts after each
    window; only the motors keep their states across windows. Randomization is off. If
    `actuator` is another motor, a force command gives it the same current as the motor of the
    training. This is what happens on the rig, whose controller converts forces to currents with the
    training's torque constant.

    Args:
        env: the environment of the training.
        path: the log, as `codrl_mj.deploy.log.read_rows` reads it.
        window: length of a window [s]; None: half a second, and at least ten rows of the log.
        actuator: motors of the simulation, by name, file or object; None: those of the training.

    Raises:
        FileNotFoundError: there is no such log.
        ValueError: the log cannot be read, or belongs to another environment; `window` is shorter
            than two rows; or the environment's state cannot be determined from its observation.
    """
    env = dataclasses.replace(env, randomize=None)
    interface = Interface.from_env(env)
    time, observed, commands = read_rows(interface, path)
    length = (
        max(round(WINDOW * interface.rate), MIN_ROWS)
        if window is None
        else round(window * interface.rate)
    )
    if window is not None and length < 2:
        raise ValueError(
            f"window = {window:g} s: must be at least {2 / interface.rate:g} s, two rows of the log"
        )
    starts = np.arange(0, len(time), length)
    simulated_env = (
        env
        if actuator is None
        else dataclasses.replace(env, actuator=dict.fromkeys(env.actuators_by_name, actuator))
    )
    if env.action == "force" and interface.levels is None:
        # Force at the joint for one ampere; 0 for an actuator without a motor, whose commands are
        # not converted.
        constants = [
            [
                motor.motor.torque_constant / motor.arm_radius if hasattr(motor, "motor") else 0.0
                for motor in actuators
            ]
            for actuators in (simulated_env.actuators, env.actuators)
        ]
        commands = commands * [
            new / old if new and old else 1.0 for new, old in zip(*constants, strict=True)
        ]
        # An unknown bound, None, becomes NaN, so that no command is beyond it.
        largest = np.array([entry["most"] for entry in interface.actions], dtype=float)
        if num_beyond := int((np.abs(commands) > largest * (1.0 + 1e-6)).any(axis=1).sum()):
            raise ValueError(
                f"{path}: in {num_beyond} rows the command, converted to this motor, is beyond the"
                f" simulation's bound, {largest.tolist()}: simulate the motor of the training, or"
                " convert the log"
            )
    simulated, actions = [], interface.to_actions(commands)
    with contextlib.closing(simulated_env.build()) as wrapped:
        simulation = cast(ActuatedEnv, wrapped.unwrapped)
        if (task := getattr(simulation, "task", None)) is None:
            raise ValueError(
                f"{interface.task}: only a task's state can be set to an observed one: must be a"
                " task"
            )
        observation, _ = simulation.reset(seed=0)
        for row, action in enumerate(actions):
            if row in starts:
                simulation.state = _state_of(task, observed[row], simulation.state)
                observation = observed[row]
            simulated.append(observation)
            observation = simulation.step(action)[0]
    names = [entry["name"] for entry in interface.observations]
    units = [entry["unit"] for entry in interface.observations]
    return RigComparison(names, units, time, observed, np.array(simulated), starts)


def _state_of(task: Task, observed: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the task's state that gives an observation; the search starts at the state `near`."""
    from scipy.optimize import least_squares

    # The observations of the motors follow the task's and are left out.
    target = observed[: len(task.observation_names)]

    def residual(state: np.ndarray) -> np.ndarray:
        difference: np.ndarray = np.array(task.observation(tuple(state)), dtype=float) - target
        return difference

    random, fit = np.random.default_rng(0), least_squares(residual, near)
    # The search may end in a local minimum of an angle, so it is repeated from other states.
    for _ in range(_STARTS):
        if fit.cost < 1e-9:
            break
        next_fit = least_squares(residual, near + random.uniform(-np.pi, np.pi, len(near)))
        fit = next_fit if next_fit.cost < fit.cost else fit
    # A rank below the number of states means that some state does not affect the observation.
    if np.linalg.matrix_rank(fit.jac, tol=1e-6) < len(near):
        raise ValueError(
            f"{task.name}: its state cannot be determined from its observation: the rig cannot be"
            " simulated"
        )
    return np.asarray(fit.x)
