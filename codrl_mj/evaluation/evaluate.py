"""How well a policy does on an actuator, and what that asks of the motor. docs/evaluation.md has every formula."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.actuators import ActuatorModel, Drive, Ideal, shaft
from codrl_mj.envs.worlds import EnvSource, find_world
from codrl_mj.evaluation.episodes import Episode, run_episodes
from codrl_mj.evaluation.measures import (
    Interval,
    Quartiles,
    bootstrap_mean,
    delay,
    drawn_and_returned,
    electrical_energy,
    holds_since,
    integral_of_square,
    interquartile_mean,
    mechanical_work,
    quartiles,
    sign_changes,
    wilson_rate,
)
from codrl_mj.runs.policies import Policy


def _measure(label: str, unit: str) -> Any:
    return dataclasses.field(metadata={"label": label, "unit": unit})


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What a policy achieved on an actuator, over all integration steps of all episodes.

    Torques, speeds and currents are the motor's own, at its shaft. Electrical measures are None for
    the ideal actuator, which has no motor.
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
    success: Interval | None = _measure("success", "share")
    """Share of episodes that succeed, as the task defines it, or as an environment of others says
    in its `info`; None where it says nothing. Wilson's interval.
    """
    failure: Interval | None = _measure("failure", "share")
    """Share of episodes that do not."""
    time_to_goal: Quartiles | None = _measure("time to goal, median", "s")
    """Time from which the goal was held until the end, in successful episodes; None if there are
    none, or if the goal is to last until the time limit.
    """
    tracking_rms: float | None = _measure("shaft torque error, rms", "N*m")
    """Root mean square of desired less delivered torque, of the motors of which a torque is asked;
    None where there is none, as where the agent commands the voltage or a position, and none of the
    tracking measures exists.
    """
    tracking_percent: float | None = _measure("shaft torque error / desired", "%")
    """The same, relative to the root mean square of the desired torque."""
    tracking_max: float | None = _measure("shaft torque error, largest", "N*m")
    """Largest absolute difference."""
    tracking_lag: float | None = _measure("shaft torque lag", "s")
    """Delay of the delivered torque behind the desired one, where they correlate best; None where they hardly do."""
    torque_rms: float = _measure("shaft torque, rms", "N*m")
    """Root mean square of the delivered torque: what wears gears and bearings, and heats a motor without a winding."""
    reversals: float = _measure("reversals", "1/s")
    """How often the delivered torque changes its sign, per second and motor: what wears gears with play."""
    saturated_percent: float | None = _measure("saturated, by any limit", "%")
    """Share of integration steps in which the actuator was at a limit, whichever: a current loop's is the voltage's."""
    voltage_saturated_percent: float | None = _measure("voltage saturated", "%")
    """Of a drive: share of those in which the voltage was at the supply's."""
    current_saturated_percent: float | None = _measure("current saturated", "%")
    """Those in which more than its largest current, or a servo's largest torque, was asked for."""
    temperature_saturated_percent: float | None = _measure("temperature saturated", "%")
    """Those in which the winding's temperature allowed less than was asked for."""
    peak_voltage: float | None = _measure("voltage, peak", "V")
    """Largest absolute voltage."""
    peak_current: float | None = _measure("current, peak", "A")
    """Largest absolute current."""
    rms_current: float | None = _measure("current, rms", "A")
    """Root mean square of the current, which heats the winding."""
    peak_speed: float | None = _measure("shaft speed, peak", "rad/s")
    """Largest absolute speed of the motor's shaft."""
    peak_temperature: float | None = _measure("winding, hottest", "degC")
    """Highest temperature of the winding; None where the motor has none."""
    energy_drawn: Interval | None = _measure("energy drawn", "J")
    """Electrical energy drawn, at the winding's terminals, in an episode."""
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
    motors: Mapping[str, Mapping[str, float | None]] = dataclasses.field(default_factory=dict)
    """Of several motors, what each of them did: name -> measure -> value, of energies the mean of an episode."""
    conditions: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """What it was measured under: environment, seed and so on, as JSON-serialisable values."""

    def as_mapping(self) -> dict[str, Any]:
        """The evaluation as JSON-serialisable values.

        Intervals are mappings of `mean`, `low` and `high`, quartiles of `median`, `low` and `high`;
        `units` has the unit of every measure.
        """
        named = {
            name: (
                value._asdict()
                if isinstance(value, Interval | Quartiles)
                else [*value]
                if type(value) is tuple
                else value
            )
            for name, value in vars(self).items()
        }
        return named | {"units": {name: field.metadata["unit"] for name, field in MEASURES.items()}}


MEASURES: dict[str, dataclasses.Field[Any]] = {
    field.name: field for field in dataclasses.fields(Evaluation) if "unit" in field.metadata
}
"""The fields of `Evaluation` that are measures: their `metadata` has a `label` and a `unit`."""


def evaluate(
    policy: Policy,
    env: Any,
    episodes: int = 100,
    seed: int = 0,
    deterministic: bool = True,
    on_step: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Measure a policy on an actuator.

    Args:
        policy: chooses actions.
        env: an `EnvConfig`: task, actuator and all else; what it randomises is drawn for every
            episode.
        episodes: their number, >= 1.
        seed: of the first episode, the others counting up from it; and of the actions that are
            sampled.
        deterministic: whether the policy takes its most likely action or samples.
        on_step: called with (episodes running, episodes finished) after every step.

    Raises:
        ValueError: an argument is unknown or out of bounds.
        SimulationDivergedError: a simulation left the finite numbers.
    """
    ran = run_episodes(policy, env.make, episodes, seed, deterministic, on_step)
    conditions = {"env": env.as_mapping(), "seed": seed, "deterministic": deterministic}
    return dataclasses.replace(summarize(env.task, ran), conditions=conditions)


def summarize(task: str, episodes: Sequence[Episode]) -> Evaluation:
    """Reduce episodes to an `Evaluation`.

    Args:
        task: the world's name: a task's, or the id of an environment of others.
        episodes: at least one, all of them with the same integration step.

    Raises:
        ValueError: unknown task.
    """
    world = find_world(task)
    returns = np.array([episode.total for episode in episodes])
    goals = [_time_to_goal(world, episode) for episode in episodes]
    reached = np.array([time for time in goals if time is not None])
    success = None
    if any(world.at_goal(episode) is not None for episode in episodes):
        success = wilson_rate(len(reached), len(episodes))
    driven = [motor_traces(episode) for episode in episodes]
    each_motor = (
        _measures(episodes, [[each[place]] for each in driven])
        for place, _ in enumerate(episodes[0].motors)
    )
    return Evaluation(
        task=world.name,
        episodes=len(episodes),
        terminated=sum(episode.terminated for episode in episodes),
        returns=bootstrap_mean(returns),
        returns_median=float(np.median(returns)),
        returns_interquartile_mean=interquartile_mean(returns),
        length=bootstrap_mean(np.array([float(len(episode.reward)) for episode in episodes])),
        success=success,
        failure=(
            None
            if success is None
            else Interval(1 - success.mean, 1 - success.high, 1 - success.low)
        ),
        time_to_goal=quartiles(reached) if world.timed and len(reached) else None,
        episode_returns=tuple(returns.tolist()),
        episode_times_to_goal=() if success is None else tuple(goals),
        motors={  # of energies the mean
            name: {
                key: value.mean if isinstance(value, Interval) else value
                for key, value in measures.items()
            }
            for name, measures in zip(episodes[0].motors, each_motor, strict=True)
        },
        **_measures(episodes, driven),
    )


def _time_to_goal(world: EnvSource, episode: Episode) -> float | None:
    """Time from which an episode that succeeded was at the goal [s]; None if it did not succeed."""
    step, at_goal = float(episode.time[0]), world.at_goal(episode)
    if at_goal is None:
        return None
    since = holds_since(at_goal) * step
    succeeded = since + world.goal_hold < episode.time[-1] + 0.5 * step  # half a step: rounding
    return since if succeeded else None


@dataclasses.dataclass(frozen=True)
class MotorTrace:
    """What one motor did in an episode, at its shaft."""

    actuator: ActuatorModel
    timestep: float
    """Of the integration [s]."""
    desired: np.ndarray
    """Torque that the agent asked for in each integration step [N*m]."""
    actual: np.ndarray
    """Torque delivered in it [N*m]."""
    speed: np.ndarray
    """Velocity of the joint before the first step and after each [m/s or rad/s]."""
    force: np.ndarray
    """Force delivered to it [N or N*m]."""
    signals: dict[str, np.ndarray]
    """The family's."""
    is_torque_controlled: bool
    """True if a torque was asked of it. If False, `desired` is the torque delivered at each step's end."""

    @property
    def work(self) -> float:
        """Work done on the joint [J]."""
        return mechanical_work(self.force, self.speed, self.timestep)

    @property
    def has_winding(self) -> bool:
        """Whether it has a winding whose current and voltage are known."""
        return {"current", "voltage"} <= self.signals.keys() and self.actuator.winding is not None

    @property
    def current(self) -> np.ndarray:
        """Before the first step, which begins with none, and after each [A]."""
        return np.append(0.0, self.signals["current"])


def motor_traces(episode: Episode) -> list[MotorTrace]:
    """What each motor did."""
    several = isinstance(episode.actuator, tuple)
    made = []
    for number, actuator in enumerate(episode.actuators):
        own = {
            name: values[:, number] if several else values for name, values in episode.trace.items()
        }
        asked = (
            episode.signals["desired_force"][:, number]
            if several
            else episode.signals["desired_force"]
        )
        arm, force, speed = actuator.arm_radius, own.pop("actual_force"), own.pop("speed")
        shown = {
            name: own[name] for name in actuator.Signals._fields if name in own
        }  # others are of other families
        made.append(
            MotorTrace(
                actuator,
                episode.timestep,
                arm * np.repeat(asked, episode.inner_steps),
                arm * force,
                np.append(episode.first_speeds[number], speed),
                force,
                shown,
                episode.is_torque_controlled[number],
            )
        )
    return made


def _measures(episodes: Sequence[Episode], driven: Sequence[Sequence[MotorTrace]]) -> dict[str, Any]:
    """What motors were asked for and did, of each episode the same ones, on the mean of them.

    How well the torque follows the desired one, which is held over an environment step; what the
    delivered one does to gears and bearings; what that asks of the supply; the work done.
    """
    actual = [one.actual for each in driven for one in each]
    delivered = np.concatenate(actual)
    tracked = [[one for one in each if one.is_torque_controlled] for each in driven]
    found: dict[str, Any] = dict.fromkeys(
        ("tracking_rms", "tracking_percent", "tracking_max", "tracking_lag")
    )
    if all(tracked):
        desired, followed = (
            [getattr(one, name) for each in tracked for one in each]
            for name in ("desired", "actual")
        )
        asked = np.concatenate(desired)
        error = asked - np.concatenate(followed)
        rms, scale = _root_mean_square(error), _root_mean_square(asked)
        found = {
            "tracking_rms": rms,
            "tracking_percent": 100 * rms / scale if scale > 0 else None,
            "tracking_max": float(np.abs(error).max()),
            "tracking_lag": delay(desired, followed, episodes[0].timestep, len(tracked[0])),
        }
    duration = math.fsum(episode.time[-1] for episode in episodes) * len(driven[0])
    return {
        **found,
        "torque_rms": _root_mean_square(delivered),
        "reversals": sum(map(sign_changes, actual)) / duration,
        **_electrical(episodes, driven),
        "mechanical_work": bootstrap_mean(
            np.array([sum(one.work for one in each) for each in driven])
        ),
    }


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _electrical(episodes: Sequence[Episode], driven: Sequence[Sequence[MotorTrace]]) -> dict[str, Any]:
    """What was asked of the actuators: of any but the ideal one, and of windings, as far as the family shows it."""
    each = (f"{limit}_saturated" for limit in ("voltage", "current", "temperature"))
    limits = {f"{name}_percent": name for name in ("saturated", *each)}
    names = (
        "peak_voltage",
        "peak_current",
        "rms_current",
        "peak_speed",
        "peak_temperature",
        "energy_drawn",
    )
    found: dict[str, Any] = dict.fromkeys(
        (*limits, *names, "energy_returned", "copper_loss", "magnetic_energy")
    )
    every = [one for each in driven for one in each if not isinstance(one.actuator, Ideal)]
    if not every:
        return found
    found["peak_speed"] = max(
        float(np.abs(one.speed).max()) / one.actuator.arm_radius for one in every
    )
    for measure, name in limits.items():
        if limited := [one.signals[name] for one in every if name in one.signals]:
            found[measure] = float(100 * np.concatenate(limited).mean())
    warmed = [one.signals["temperature"] for one in every if "temperature" in one.signals]
    if warmed and any(
        np.ptp(values) > 0.0 for values in warmed
    ):  # constant where nothing is known of it
        found["peak_temperature"] = float(np.concatenate(warmed).max())
    wound = [[one for one in each if one.has_winding] for each in driven]
    every = [one for each in wound for one in each]
    if not every:
        return found
    energies = [[_energies(one) for one in each] for each in wound]
    drawn, returned, copper, magnetic, squares = np.array(
        [np.sum(each, axis=0) for each in energies]
    ).T
    duration = math.fsum(episode.time[-1] for episode in episodes) * len(wound[0])
    return found | {
        "peak_voltage": float(
            np.abs(np.concatenate([one.signals["voltage"] for one in every])).max()
        ),
        "peak_current": float(
            np.abs(np.concatenate([one.signals["current"] for one in every])).max()
        ),
        "rms_current": math.sqrt(squares.sum() / duration),
        "energy_drawn": bootstrap_mean(drawn),
        "energy_returned": bootstrap_mean(returned),
        "copper_loss": bootstrap_mean(copper),
        "magnetic_energy": bootstrap_mean(magnetic),
    }


def _energies(one: MotorTrace) -> tuple[float, float, float, float, float]:
    """Energy [J] drawn, returned, lost in the winding and left in it; the integral of the squared current [A^2*s]."""
    assert one.actuator.winding is not None
    resistance, inductance = one.actuator.winding
    stored = inductance * one.current[-1] ** 2 / 2
    if isinstance(one.actuator, Drive):  # whose steps are long beside its winding
        heat = one.signals["copper_loss"] * one.timestep
        temperature: Any = one.signals["temperature"]
        warm = shaft.resistance_at(one.actuator.motor, temperature)
        drawn, returned = drawn_and_returned(one.signals["electrical_power"] * one.timestep)
        return drawn, returned, float(heat.sum()), stored, float((heat / warm).sum())
    drawn, returned = electrical_energy(one.signals["voltage"], one.current, one.timestep)
    square = integral_of_square(one.current, one.timestep)
    return drawn, returned, resistance * square, stored, square
