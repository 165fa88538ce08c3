"""How well a policy does on an actuator, and what that asks of the motor. docs/evaluation.md has every formula."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation.episodes import Episode, make_env, run_episodes
from codrl_mj.evaluation.measures import (
    Interval,
    Quartiles,
    bootstrap_mean,
    delay,
    electrical_energy,
    holds_since,
    integral_of_square,
    interquartile_mean,
    mechanical_work,
    quartiles,
    wilson_rate,
)
from codrl_mj.motor import Actuator, resolve
from codrl_mj.physics.analytic import DRIVERS
from codrl_mj.physics.base import TRACE_ACTUAL_FORCE, TRACE_CURRENT, TRACE_SATURATED, TRACE_SPEED, TRACE_VOLTAGE
from codrl_mj.runs.policies import Policy
from codrl_mj.tasks import Task, find_task


def _measure(label: str, unit: str) -> Any:
    return dataclasses.field(metadata={"label": label, "unit": unit})


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What a policy achieved on an actuator, over all integration steps of all episodes.

    Torques, speeds and currents are the motor's own, at its shaft. Electrical measures are None for the ideal actuator,
    which has no motor.
    """

    task: str
    """The task's name."""
    episodes: int
    """Number of episodes."""
    terminated: int
    """How many of them the task ended; the time limit ended the others."""
    returns: Interval = _measure("return", "reward")
    """Return: the sum of an episode's rewards."""
    returns_median: float = _measure("return, median", "reward")
    """Median return."""
    returns_interquartile_mean: float = _measure("return, interquartile mean", "reward")
    """Mean return of the episodes without the best and the worst quarter."""
    length: Interval = _measure("length", "steps")
    """Environment steps per episode."""
    success: Interval = _measure("success", "share")
    """Share of episodes that succeed, as the task defines it; Wilson's interval."""
    failure: Interval = _measure("failure", "share")
    """Share of episodes that do not."""
    time_to_goal: Quartiles | None = _measure("time to goal, median", "s")
    """Time from which the goal was held until the end, in successful episodes; None if there are none, or if the goal
    is to last until the time limit."""
    tracking_rms: float | None = _measure("torque error, rms", "N*m")
    """Root mean square of desired less delivered torque; None where the agent commands the voltage, and none of the
    tracking measures exists."""
    tracking_percent: float | None = _measure("torque error / desired", "%")
    """The same, relative to the root mean square of the desired torque."""
    tracking_max: float | None = _measure("torque error, largest", "N*m")
    """Largest absolute difference."""
    tracking_lag: float | None = _measure("torque lag", "s")
    """Delay of the delivered torque behind the desired one, where they correlate best; None where they hardly do."""
    saturated_percent: float | None = _measure("voltage saturated", "%")
    """Share of integration steps that ended with the voltage at its limit."""
    peak_voltage: float | None = _measure("voltage, peak", "V")
    """Largest absolute voltage."""
    peak_current: float | None = _measure("current, peak", "A")
    """Largest absolute current."""
    rms_current: float | None = _measure("current, rms", "A")
    """Root mean square of the current, which heats the winding."""
    peak_speed: float | None = _measure("speed, peak", "rad/s")
    """Largest absolute speed of the motor's shaft."""
    energy_drawn: Interval | None = _measure("energy drawn", "J")
    """Electrical energy drawn from the supply in an episode."""
    energy_returned: Interval | None = _measure("energy returned", "J")
    """Electrical energy returned to it in an episode, which many supplies cannot take."""
    copper_loss: Interval | None = _measure("copper loss", "J")
    """Heat in the winding in an episode."""
    magnetic_energy: Interval | None = _measure("energy in winding", "J")
    """Energy in the winding's magnetic field at the end of an episode."""
    mechanical_work: Interval = _measure("mechanical work", "J")
    """Work done on the joint in an episode."""
    episode_returns: tuple[float, ...] = ()
    """Return of each episode, in the order of their seeds."""
    episode_times_to_goal: tuple[float | None, ...] = ()
    """Time to the goal of each episode [s]; None where it did not succeed, 0 where the goal is to last."""
    conditions: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """What it was measured under: actuator, environment, seed and so on, as JSON-serialisable values."""

    def as_mapping(self) -> dict[str, Any]:
        """The evaluation as JSON-serialisable values.

        Intervals are mappings of `mean`, `low` and `high`, quartiles of `median`, `low` and `high`; `units` has the
        unit of every measure.
        """
        named = {name: _plain(value) for name, value in vars(self).items()}
        return named | {"units": {name: field.metadata["unit"] for name, field in MEASURES.items()}}


def _plain(value: Any) -> Any:
    """The value as JSON has it."""
    if isinstance(value, Interval | Quartiles):
        return value._asdict()
    return list(value) if isinstance(value, tuple) else value


MEASURES: dict[str, dataclasses.Field[Any]] = {
    field.name: field for field in dataclasses.fields(Evaluation) if "unit" in field.metadata
}
"""The fields of `Evaluation` that are measures: their `metadata` has a `label` and a `unit`."""


def evaluate(
    policy: Policy,
    task: str,
    actuator: str | Actuator | Mapping[str, Any] | None = "paper",
    env: EnvConfig = EnvConfig(),  # noqa: B008 - frozen
    episodes: int = 100,
    seed: int = 0,
    deterministic: bool = True,
    on_step: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Measure a policy on an actuator.

    Args:
        policy: chooses actions.
        task: the task's name.
        actuator: a name, an `Actuator`, a mapping of its fields, or None (ideal).
        env: the environment's other arguments; what it randomises is drawn for every episode.
        episodes: their number, >= 1.
        seed: of the first episode, the others counting up from it; and of the actions that are sampled.
        deterministic: whether the policy takes its most likely action or samples.
        on_step: called with (episodes running, episodes finished) after every step.

    Raises:
        ValueError: an argument is unknown or out of bounds.
        SimulationDivergedError: a simulation left the finite numbers.
    """
    nominal = resolve(actuator, find_task(task).name)
    arguments = env.as_arguments()
    conditions = {
        "actuator": None if nominal is None else nominal.as_mapping(),
        "env": dataclasses.asdict(env),
        "seed": seed,
        "deterministic": deterministic,
    }
    ran = run_episodes(policy, lambda: make_env(task, nominal, **arguments), episodes, seed, deterministic, on_step)
    return dataclasses.replace(summarize(task, nominal, ran), conditions=conditions)


def summarize(task: str, actuator: Actuator | None, episodes: Sequence[Episode]) -> Evaluation:
    """Reduce episodes to an `Evaluation`.

    Args:
        task: the task's name.
        actuator: what they ran on, before anything was drawn; None is the ideal actuator.
        episodes: at least one, all of them with the same integration step.

    Raises:
        ValueError: unknown task.
    """
    definition = find_task(task)
    returns = np.array([episode.total for episode in episodes])
    goals = [_time_to_goal(definition, episode) for episode in episodes]
    reached = np.array([time for time in goals if time is not None])
    success = wilson_rate(len(reached), len(episodes))
    return Evaluation(
        task=definition.name,
        episodes=len(episodes),
        terminated=sum(episode.terminated for episode in episodes),
        returns=bootstrap_mean(returns),
        returns_median=float(np.median(returns)),
        returns_interquartile_mean=interquartile_mean(returns),
        length=_mean_of(episodes, lambda episode: len(episode.reward)),
        success=success,
        failure=Interval(1 - success.mean, 1 - success.high, 1 - success.low),
        time_to_goal=quartiles(reached) if definition.goal is not None and len(reached) else None,
        mechanical_work=_mean_of(episodes, lambda episode: _work(definition, episode)),
        episode_returns=tuple(returns.tolist()),
        episode_times_to_goal=tuple(goals),
        **_tracking(episodes),
        **(dict.fromkeys(_ELECTRICAL) if actuator is None else _electrical(definition, episodes)),
    )


def _mean_of(episodes: Sequence[Episode], value: Callable[[Episode], float]) -> Interval:
    """Mean over the episodes."""
    return bootstrap_mean(np.array([value(episode) for episode in episodes], dtype=float))


def _time_to_goal(task: Task, episode: Episode) -> float | None:
    """Time from which an episode that succeeded was at the goal [s]; None if it did not succeed."""
    if task.goal is None:
        return None if episode.terminated else 0.0
    since = holds_since(task.goal(episode.state.T)) * task.step_duration
    succeeded = since + task.goal_hold < episode.time[-1] + 0.5 * task.step_duration  # half a step: rounding
    return since if succeeded else None


def _arm(episode: Episode) -> float:
    """Torque at the motor's shaft for a force of one; 1 for the ideal actuator."""
    return 1.0 if episode.actuator is None else episode.actuator.motor.arm_radius


def _speed(task: Task, episode: Episode) -> np.ndarray:
    """Velocity of the actuated joint before the first integration step and after each [m/s or rad/s]."""
    return np.append(episode.state[0, DRIVERS[task.name].speed], episode.trace[:, TRACE_SPEED])


def _work(task: Task, episode: Episode) -> float:
    """Work done on the joint [J]."""
    return mechanical_work(episode.trace[:, TRACE_ACTUAL_FORCE], _speed(task, episode), episode.timestep)


def _tracking(episodes: Sequence[Episode]) -> dict[str, Any]:
    """The measures of how well the torque follows the desired one, which is held over an environment step."""
    if any(episode.command == "voltage" for episode in episodes):
        return dict.fromkeys(("tracking_rms", "tracking_percent", "tracking_max", "tracking_lag"))
    desired = [_arm(episode) * np.repeat(episode.signals["desired_force"], episode.inner_steps) for episode in episodes]
    actual = [_arm(episode) * episode.trace[:, TRACE_ACTUAL_FORCE] for episode in episodes]
    asked = np.concatenate(desired)
    error = asked - np.concatenate(actual)
    rms, scale = _root_mean_square(error), _root_mean_square(asked)
    return {
        "tracking_rms": rms,
        "tracking_percent": 100 * rms / scale if scale > 0 else None,
        "tracking_max": float(np.abs(error).max()),
        "tracking_lag": delay(desired, actual, episodes[0].timestep),
    }


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


_ELECTRICAL = (
    "saturated_percent",
    "peak_voltage",
    "peak_current",
    "rms_current",
    "peak_speed",
    "energy_drawn",
    "energy_returned",
    "copper_loss",
    "magnetic_energy",
)


def _electrical(task: Task, episodes: Sequence[Episode]) -> dict[str, Any]:
    """The measures of `_ELECTRICAL`, for episodes with a motor, which begin with no current."""
    rows = np.concatenate([episode.trace for episode in episodes])
    motors = [episode.actuator.motor for episode in episodes if episode.actuator is not None]
    currents = [np.append(0.0, episode.trace[:, TRACE_CURRENT]) for episode in episodes]
    squares = np.array([integral_of_square(i, e.timestep) for i, e in zip(currents, episodes, strict=True)])
    flows = [
        electrical_energy(episode.trace[:, TRACE_VOLTAGE], current, episode.timestep)
        for episode, current in zip(episodes, currents, strict=True)
    ]
    drawn, returned = np.array(flows).T
    resistance = np.array([motor.resistance for motor in motors])
    left = np.array([motor.inductance * i[-1] ** 2 / 2 for motor, i in zip(motors, currents, strict=True)])
    duration = math.fsum(episode.time[-1] for episode in episodes)
    return {
        "saturated_percent": float(100 * rows[:, TRACE_SATURATED].mean()),
        "peak_voltage": float(np.abs(rows[:, TRACE_VOLTAGE]).max()),
        "peak_current": float(np.abs(rows[:, TRACE_CURRENT]).max()),
        "rms_current": math.sqrt(squares.sum() / duration),
        "peak_speed": max(float(np.abs(_speed(task, episode)).max()) / _arm(episode) for episode in episodes),
        "energy_drawn": bootstrap_mean(drawn),
        "energy_returned": bootstrap_mean(returned),
        "copper_loss": bootstrap_mean(resistance * squares),
        "magnetic_energy": bootstrap_mean(left),
    }
