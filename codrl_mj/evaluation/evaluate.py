"""Measures of a policy on an actuator and of the motor's load; formulas: docs/evaluation.md."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.actuators import ActuatorModel, Geared, Ideal, shaft
from codrl_mj.boundary import Json
from codrl_mj.envs.config import EnvConfig, check_time_limit, find_source
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
from codrl_mj.fields import DeclaredField
from codrl_mj.runs.policies import Policy
from codrl_mj.tasks import Task


def _measure(label: str, unit: str) -> DeclaredField:
    return dataclasses.field(metadata={"label": label, "unit": unit})


Measures = dict[str, float | Interval | None]
"""Measure of motors -> value, under the names of the fields of `Evaluation`."""


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Measures of a policy on an actuator, over all integration steps of all episodes.

    Torques, speeds and currents refer to the motor's shaft. Electrical measures are None for
    the ideal actuator, which has no motor.
    """

    task: str
    """Name of the task."""
    episodes: int
    """Number of episodes."""
    terminated: int
    """Number of episodes that the task ended; the time limit ended the others."""
    returns: Interval = _measure("return", "reward")
    """Return: the sum of an episode's rewards."""
    returns_median: float = _measure("return, median", "reward")
    """Median return."""
    returns_interquartile_mean: float = _measure("return, interquartile mean", "reward")
    """Mean return of the episodes without the best and the worst quarter."""
    length: Interval = _measure("length", "steps")
    """Environment steps per episode."""
    success: Interval | None = _measure("success", "share")
    """Share of successful episodes, as defined by the task or by the `info` of a third-party
    environment, with Wilson's interval; None if neither defines it.
    """
    failure: Interval | None = _measure("failure", "share")
    """Share of episodes that do not succeed."""
    time_to_goal: Quartiles | None = _measure("time to goal, median", "s")
    """Time from which the goal is held until the end, in successful episodes; None without
    successful episodes, or if the goal is to survive until the time limit.
    """
    tracking_rms: float | None = _measure("shaft torque error, rms", "N*m")
    """Root mean square of desired minus delivered torque, over motors with a torque command. All
    tracking measures are None without such a motor, as with a voltage or position command.
    """
    tracking_percent: float | None = _measure("shaft torque error / desired", "%")
    """Root mean square error, relative to that of the desired torque."""
    tracking_max: float | None = _measure("shaft torque error, largest", "N*m")
    """Largest absolute error of the torque."""
    tracking_lag: float | None = _measure("shaft torque lag", "s")
    """Delay of the delivered torque at the best correlation; None if the correlation is weak."""
    torque_rms: float = _measure("shaft torque, rms", "N*m")
    """Root mean square of the delivered torque: a measure of wear, and of heating."""
    reversals: float = _measure("reversals", "1/s")
    """Sign changes of the delivered torque per second and motor, which wear gears with backlash."""
    saturated_percent: float | None = _measure("saturated, by any limit", "%")
    """Share of integration steps at any limit; for a current loop, at the voltage limit."""
    voltage_saturated_percent: float | None = _measure("voltage saturated", "%")
    """Share of integration steps in which a drive's voltage was at the supply's limit."""
    current_saturated_percent: float | None = _measure("current saturated", "%")
    """Share of steps with a command above the drive's largest current or the servo's torque."""
    temperature_saturated_percent: float | None = _measure("temperature saturated", "%")
    """Share of steps in which the winding's temperature limited the current."""
    peak_voltage: float | None = _measure("voltage, peak", "V")
    """Largest absolute voltage."""
    peak_current: float | None = _measure("current, peak", "A")
    """Largest absolute current."""
    rms_current: float | None = _measure("current, rms", "A")
    """Root mean square of the current, which heats the winding."""
    peak_speed: float | None = _measure("shaft speed, peak", "rad/s")
    """Largest absolute speed of the motor's shaft."""
    peak_temperature: float | None = _measure("winding, hottest", "degC")
    """Highest temperature of the winding; None without a thermal model."""
    energy_drawn: Interval | None = _measure("energy drawn", "J")
    """Electrical energy drawn, at the winding's terminals, in an episode."""
    energy_returned: Interval | None = _measure("energy returned", "J")
    """Electrical energy returned to the supply in an episode, which many supplies cannot absorb."""
    copper_loss: Interval | None = _measure("copper loss", "J")
    """Heat in the winding in an episode."""
    magnetic_energy: Interval | None = _measure("energy in winding", "J")
    """Energy in the winding's magnetic field at the end of an episode."""
    mechanical_work: Interval = _measure("mechanical work", "J")
    """Work done on the joint in an episode."""
    episode_returns: tuple[float, ...] = ()
    """Return of each episode, in the order of their seeds."""
    episode_times_to_goal: tuple[float | None, ...] = ()
    """Time to the goal of each episode [s]; None if it failed, 0 if the goal is to survive."""
    motors: Mapping[str, Mapping[str, float | None]] = dataclasses.field(default_factory=dict)
    """Measures of each of several motors: name -> measure -> value; energies are episode means."""
    conditions: Mapping[str, Json] = dataclasses.field(default_factory=dict)
    """Conditions of the evaluation (environment, seed, ...), as JSON-serializable values."""

    def as_mapping(self) -> dict[str, Json]:
        """Return the evaluation as JSON-serializable values.

        An interval becomes a mapping with `mean`, `low` and `high`, quartiles one with `median`,
        `low` and `high`; `units` maps each measure to its unit.
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


MEASURES: dict[str, dataclasses.Field[object]] = {
    field.name: field for field in dataclasses.fields(Evaluation) if "unit" in field.metadata
}
"""Measures of `Evaluation`: the fields whose `metadata` has a `label` and a `unit`."""


def evaluate(
    policy: Policy,
    env: EnvConfig,
    episodes: int = 100,
    seed: int = 0,
    deterministic: bool = True,
    on_step: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Measure a policy on an actuator.

    Args:
        policy: policy that chooses actions.
        env: an `EnvConfig`; its randomized parameters are drawn for every episode.
        episodes: number of episodes, >= 1.
        seed: seed of the first episode, incremented for each further one; also the seed of sampled
            actions.
        deterministic: True for the most likely action, False for a sampled one.
        on_step: called with (episodes running, episodes finished) after every step.

    Raises:
        ValueError: an argument is unknown or out of bounds, or the policy was trained with other
            observations or actions.
        SimulationDivergedError: a simulation has a value that is not finite.
    """
    check_time_limit(env)
    recorded_episodes = run_episodes(policy, env.build, episodes, seed, deterministic, on_step)
    conditions = {"env": env.as_mapping(), "seed": seed, "deterministic": deterministic}
    return dataclasses.replace(summarize(env.task, recorded_episodes), conditions=conditions)


def summarize(task: str, episodes: Sequence[Episode]) -> Evaluation:
    """Reduce episodes to an `Evaluation`.

    Args:
        task: name of a task, or id of a third-party environment.
        episodes: at least one; all with the same integration step.

    Raises:
        ValueError: unknown task.
    """
    env_source = find_source(task)
    own_task = env_source.task
    returns = np.array([episode.total for episode in episodes])
    goals = [_time_to_goal(own_task, episode) for episode in episodes]
    reached = np.array([time for time in goals if time is not None])
    # A task without a goal is to survive until the time limit.
    reports_time = own_task is not None and own_task.goal is not None
    success = None
    if any(at_goal(own_task, episode) is not None for episode in episodes):
        success = wilson_rate(len(reached), len(episodes))
    traces_by_episode = [motor_traces(episode) for episode in episodes]
    each_motor = (
        _measures(episodes, [[traces[motor_index]] for traces in traces_by_episode])
        for motor_index, _ in enumerate(episodes[0].motors)
    )
    # Each measure has the type of its field.
    measures: dict[str, Any] = {**_measures(episodes, traces_by_episode)}
    return Evaluation(
        task=env_source.name,
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
        time_to_goal=quartiles(reached) if reports_time and len(reached) else None,
        episode_returns=tuple(returns.tolist()),
        episode_times_to_goal=() if success is None else tuple(goals),
        # A motor's energies are means over the episodes, without intervals.
        motors={
            name: {
                key: value.mean if isinstance(value, Interval) else value
                for key, value in motor_measures.items()
            }
            for name, motor_measures in zip(episodes[0].motors, each_motor, strict=True)
        },
        **measures,
    )


def at_goal(task: Task | None, episode: Episode) -> np.ndarray | None:
    """Return a bool array (T+1,), True for states at the goal; None if the goal is unknown.

    A task without a goal is at its goal in all states, unless the episode terminated. A third-party
    environment reports only at the end of an episode whether it succeeded.
    """
    if task is None:
        succeeded = episode.succeeded
        return None if succeeded is None else np.full(len(episode.state), succeeded)
    if task.goal is None:
        return np.full(len(episode.state), not episode.terminated)
    return np.asarray(task.goal(episode.state.T), dtype=bool)


def _time_to_goal(task: Task | None, episode: Episode) -> float | None:
    """Return the time from which a successful episode holds the goal [s]; None if it failed."""
    step, mask = float(episode.time[0]), at_goal(task, episode)
    if mask is None:
        return None
    since = holds_since(mask) * step
    hold_duration = 0.0 if task is None else task.goal_hold
    # Half a step is added because times are sums of floating-point steps.
    succeeded = since + hold_duration < episode.time[-1] + 0.5 * step
    return since if succeeded else None


@dataclasses.dataclass(frozen=True)
class MotorTrace:
    """Recording of one motor in an episode, at its shaft."""

    actuator: ActuatorModel
    timestep: float
    """Integration step [s]."""
    desired: np.ndarray
    """Torque commanded by the agent in each integration step [N*m]."""
    actual: np.ndarray
    """Torque delivered in each integration step [N*m]."""
    speed: np.ndarray
    """Velocity of the joint before the first step and after each [m/s or rad/s]."""
    force: np.ndarray
    """Force delivered to the joint [N or N*m]."""
    signals: dict[str, np.ndarray]
    """Signals of the actuator family."""
    is_torque_controlled: bool
    """True if the command is a torque. If False, `desired` is the torque at each step's end."""

    @property
    def work(self) -> float:
        """Work done on the joint [J]."""
        return mechanical_work(self.force, self.speed, self.timestep)

    @property
    def has_winding(self) -> bool:
        """True if the motor has a winding with known current and voltage."""
        return {"current", "voltage"} <= self.signals.keys() and self.actuator.winding is not None

    @property
    def current(self) -> np.ndarray:
        """Current before the first step, which is 0, and after each [A]."""
        return np.append(0.0, self.signals["current"])


def motor_traces(episode: Episode) -> list[MotorTrace]:
    """Return the recording of each motor."""
    has_several = isinstance(episode.actuator, tuple)
    traces = []
    for motor_index, actuator in enumerate(episode.actuators):
        motor_trace = {
            name: values[:, motor_index] if has_several else values
            for name, values in episode.trace.items()
        }
        desired = (
            episode.signals["desired_force"][:, motor_index]
            if has_several
            else episode.signals["desired_force"]
        )
        arm = actuator.arm_radius
        force = motor_trace.pop("actual_force")
        speed = motor_trace.pop("speed")
        # With several motors the trace has the signals of all their families.
        signals = {
            name: motor_trace[name] for name in actuator.Signals._fields if name in motor_trace
        }
        traces.append(
            MotorTrace(
                actuator,
                episode.timestep,
                arm * np.repeat(desired, episode.inner_steps),
                arm * force,
                np.append(episode.first_speeds[motor_index], speed),
                force,
                signals,
                episode.is_torque_controlled[motor_index],
            )
        )
    return traces


def _measures(
    episodes: Sequence[Episode], traces_by_episode: Sequence[Sequence[MotorTrace]]
) -> Measures:
    """Return the measures of the same motors in every episode, averaged over the motors.

    They describe how well the torque follows the command (which is held over an environment step),
    the load on gears and bearings, the load on the supply, and the mechanical work.
    """
    actual = [trace.actual for traces in traces_by_episode for trace in traces]
    delivered = np.concatenate(actual)
    tracked = [
        [trace for trace in traces if trace.is_torque_controlled] for traces in traces_by_episode
    ]
    tracking: Measures = dict.fromkeys(
        ("tracking_rms", "tracking_percent", "tracking_max", "tracking_lag")
    )
    if all(tracked):
        desired, tracked_actual = (
            [getattr(trace, name) for traces in tracked for trace in traces]
            for name in ("desired", "actual")
        )
        command = np.concatenate(desired)
        error = command - np.concatenate(tracked_actual)
        rms, scale = _root_mean_square(error), _root_mean_square(command)
        tracking = {
            "tracking_rms": rms,
            "tracking_percent": 100 * rms / scale if scale > 0 else None,
            "tracking_max": float(np.abs(error).max()),
            "tracking_lag": delay(desired, tracked_actual, episodes[0].timestep, len(tracked[0])),
        }
    duration = math.fsum(episode.time[-1] for episode in episodes) * len(traces_by_episode[0])
    return {
        **tracking,
        "torque_rms": _root_mean_square(delivered),
        "reversals": sum(map(sign_changes, actual)) / duration,
        **_electrical(episodes, traces_by_episode),
        "mechanical_work": bootstrap_mean(
            np.array([sum(trace.work for trace in traces) for traces in traces_by_episode])
        ),
    }


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _electrical(
    episodes: Sequence[Episode], traces_by_episode: Sequence[Sequence[MotorTrace]]
) -> Measures:
    """Return the measures of non-ideal actuators and windings; None where signals are missing."""
    signal_names = (f"{limit}_saturated" for limit in ("voltage", "current", "temperature"))
    limits = {f"{name}_percent": name for name in ("saturated", *signal_names)}
    names = (
        "peak_voltage",
        "peak_current",
        "rms_current",
        "peak_speed",
        "peak_temperature",
        "energy_drawn",
    )
    measures: Measures = dict.fromkeys(
        (*limits, *names, "energy_returned", "copper_loss", "magnetic_energy")
    )
    all_traces = [
        trace
        for traces in traces_by_episode
        for trace in traces
        if not isinstance(trace.actuator, Ideal)
    ]
    if not all_traces:
        return measures
    measures["peak_speed"] = max(
        float(np.abs(trace.speed).max()) / trace.actuator.arm_radius for trace in all_traces
    )
    for measure, name in limits.items():
        if flags := [trace.signals[name] for trace in all_traces if name in trace.signals]:
            measures[measure] = float(100 * np.concatenate(flags).mean())
    temperatures = [
        trace.signals["temperature"] for trace in all_traces if "temperature" in trace.signals
    ]
    # Without a thermal model the signal is constant.
    if temperatures and any(np.ptp(values) > 0.0 for values in temperatures):
        measures["peak_temperature"] = float(np.concatenate(temperatures).max())
    with_winding = [
        [trace for trace in traces if trace.has_winding] for traces in traces_by_episode
    ]
    all_traces = [trace for traces in with_winding for trace in traces]
    if not all_traces:
        return measures
    energies = [[_energies(trace) for trace in traces] for traces in with_winding]
    drawn, returned, copper, magnetic, squares = np.array(
        [np.sum(traces, axis=0) for traces in energies]
    ).T
    duration = math.fsum(episode.time[-1] for episode in episodes) * len(with_winding[0])
    return measures | {
        "peak_voltage": float(
            np.abs(np.concatenate([trace.signals["voltage"] for trace in all_traces])).max()
        ),
        "peak_current": float(
            np.abs(np.concatenate([trace.signals["current"] for trace in all_traces])).max()
        ),
        "rms_current": math.sqrt(squares.sum() / duration),
        "energy_drawn": bootstrap_mean(drawn),
        "energy_returned": bootstrap_mean(returned),
        "copper_loss": bootstrap_mean(copper),
        "magnetic_energy": bootstrap_mean(magnetic),
    }


def _energies(trace: MotorTrace) -> tuple[float, float, float, float, float]:
    """Return energies [J] drawn, returned, lost and stored, and the integral of i^2 [A^2*s]."""
    assert trace.actuator.winding is not None
    resistance, inductance = trace.actuator.winding
    stored = inductance * trace.current[-1] ** 2 / 2
    # An integration step of a drive is long compared to its winding's time constant, so the samples
    # of the current do not give the energies. A geared motor integrates them within each step.
    if isinstance(trace.actuator, Geared):
        heat = trace.signals["copper_loss"] * trace.timestep
        # The formula for one temperature also holds for an array of them.
        temperature: Any = trace.signals["temperature"]
        warm_resistance = shaft.resistance_at(trace.actuator.motor, temperature)
        drawn, returned = drawn_and_returned(trace.signals["electrical_power"] * trace.timestep)
        return drawn, returned, float(heat.sum()), stored, float((heat / warm_resistance).sum())
    drawn, returned = electrical_energy(trace.signals["voltage"], trace.current, trace.timestep)
    square = integral_of_square(trace.current, trace.timestep)
    return drawn, returned, resistance * square, stored, square
