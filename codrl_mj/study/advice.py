"""Recommendation for an actuator on a task, from a simulated bench test and the study's results.

The bench test gives the actuator a severity on each axis of the study. The loss of policies trained
on ideal forces is interpolated, policy by policy, between the severities that the study tested, and
the losses of all axes are added. A saturating drive without anti-windup has the loss of its wind-up
besides. For policies trained on random actuators or through the actuator, a study's test gives an
upper bound if its severities are at least as large on every axis, and a lower bound if they are at
most as large. A `Measurement` needs none of these assumptions: it trains and tests new policies, in
any environment, and applies the same rule (`decide`).
"""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import IDEAL as IDEAL_ACTUATOR
from codrl_mj.actuators import ActuatorModel, ActuatorSetting
from codrl_mj.envs.config import StoredActuators
from codrl_mj.evaluation import RandomPolicy, evaluate
from codrl_mj.evaluation.measures import Interval
from codrl_mj.study.axes import (
    AXES,
    FLOORS,
    REAL,
    SECONDS,
    ideal_arm,
    random_arm,
    random_ranges,
    random_training,
    study_env,
)
from codrl_mj.study.bench import (
    ActuatorResponse,
    fix_sensor,
    has_wind_up,
    measure_on_task,
    measure_with_larger_command,
    redesign_loop,
    severities,
)
from codrl_mj.study.evidence import (
    TOLERANCES,
    WIND_UP,
    Evidence,
    Loss,
    LossBounds,
    Outcome,
    gains,
    interpolate,
    is_better,
    sum_outcomes,
)
from codrl_mj.study.questions import MARGIN, Scores
from codrl_mj.study.trials import Arm, Grid, StudyResults, Trial
from codrl_mj.training import TrainConfig, load_config
from codrl_mj.training.config import default_agent

IDEAL, COMMAND, LOOP = "train on ideal", "command more", "design the loop"
SENSOR, RANDOMIZE, THROUGH = "fix the sensor", "randomise", "train through it"
BUY, MEASURE = "buy another", "measure it"
OPTIONS = (IDEAL, COMMAND, LOOP, SENSOR, RANDOMIZE, THROUGH)
"""Options for an actuator, in order of effort. The other two verdicts are `BUY` and `MEASURE`."""
SAME_POLICIES = (COMMAND, LOOP, SENSOR)
"""Options without a new training: the same policies as with `IDEAL`."""
RANDOM = "random"
"""Arm trained on random actuators with the ranges that are recommended (`axes.RANDOM_RANGES`)."""
BENCH_ERROR = 0.002
"""Largest error of a severity that the bench measures, besides 0.5 %, because of its time step."""


def decide(options: Mapping[str, LossBounds]) -> str:
    """Return the recommended option; the rule is the same for predicted and measured losses.

    1. `IDEAL` if its loss is negligible, and `MEASURE` if it may or may not be: otherwise effort
       would be recommended that nothing shows to be needed.
    2. Otherwise the first of `OPTIONS` whose loss is negligible.
    3. Otherwise consider the options that are certainly better than training on ideal forces
       (`is_better`), and return the first that is not certainly worse than the best of them. An
       option with which every policy fails is not considered.
    4. Otherwise `BUY` if every option is certainly harmful.
    5. Otherwise `MEASURE`.

    The rule was revised with the study's rows in sight, so that its success on these rows
    (docs/results/actuators.md) is no independent test of it.
    """
    known_options = {name: options[name] for name in OPTIONS if name in options}
    ideal_trained = known_options[IDEAL]
    if ideal_trained.upper is not None and ideal_trained.upper.is_negligible:
        return IDEAL
    if ideal_trained.lower is None or ideal_trained.lower.is_negligible:
        return MEASURE
    upper = {
        name: option.upper
        for name, option in known_options.items()
        if option.upper is not None and name != IDEAL
    }
    for name, outcome in upper.items():
        if outcome.is_negligible:
            return name
    better = [
        name
        for name, outcome in upper.items()
        if is_better(outcome, ideal_trained.lower, name in SAME_POLICIES)
    ]
    if better:
        best = min(better, key=lambda name: upper[name].loss.mean)
        return next(
            name
            for name in better
            if not is_better(
                upper[best], upper[name], best in SAME_POLICIES and name in SAME_POLICIES
            )
        )
    all_harmful = all(
        option.lower is not None and option.lower.is_harmful for option in known_options.values()
    )
    return BUY if all_harmful else MEASURE


class Advice(NamedTuple):
    """Recommendation for an actuator on a task."""

    task: str
    """Task name."""
    response: ActuatorResponse
    """Response of the actuator on the bench."""
    losses: tuple[Loss, ...]
    """Losses of policies trained on ideal forces, by axis; empty if the study has no results."""
    options: Mapping[str, LossBounds]
    """Loss bounds by option, in the order of `OPTIONS`; empty if the study has no results."""
    verdict: str | None
    """One of `OPTIONS`, `BUY` or `MEASURE`; None without evidence."""
    reason: str
    """Reason for the verdict, in a sentence."""
    command: str
    """Command line of the training, with its ranges, for `RANDOMIZE`; otherwise empty."""

    def summary(self) -> dict[str, object]:
        """Return the fields under the keys of the command line's JSON output."""
        names = {"response": "found"}
        return {names.get(name, name): value for name, value in self._asdict().items()}


def advise(actuator: ActuatorModel, task: str, evidence: Evidence) -> Advice:
    """Recommend an option for a force-controlled actuator on a task from the study's results."""
    response = measure_on_task(actuator, task)
    requested = _requested(actuator, response, task)
    losses = predict_losses(evidence, task, requested)
    if not {loss.axis for loss in losses} >= set(AXES):
        reason = "no results of the study are available for this task: measure it"
        return Advice(task, response, (), {}, None, reason, "")
    options = option_bounds(evidence, task, requested, least_lag=response.least_lag)
    improved = {
        name: (model, measure_on_task(model, task))
        for name, model in (
            (LOOP, redesign_loop(actuator, task)),
            (SENSOR, fix_sensor(actuator)),
        )
        if model is not None
    }
    boosted = measure_with_larger_command(actuator, task, response)
    for name, (model, improved_response) in (
        improved if boosted is None else {**improved, COMMAND: (actuator, boosted)}
    ).items():
        severity = _requested(model, improved_response, task)
        bounds = option_bounds(evidence, task, severity, {}, improved_response.least_lag)
        options[name] = bounds[IDEAL]
    # The study has no axis for excess force or for an offset, so that it predicts no loss for them.
    untested = ""
    if max(response.at_rest, response.at_speed) > 1.0 + MARGIN:
        untested = "it delivers more force than commanded"
    # The mean of correlated noise samples stays below half their standard deviation, so that noise
    # alone does not count as an offset.
    if response.unasked > max(0.02, response.noise / 2.0):
        untested = f"it delivers {response.unasked:.2g} of the largest force at a command of zero"
    verdict = MEASURE if untested else decide(options)
    reason = (
        f"{untested}, which was not tested" if untested else _reason(verdict, options, response)
    )
    command = random_training(task) if verdict == RANDOMIZE else ""
    return Advice(task, response, losses, options, verdict, reason, command)


def _requested(actuator: ActuatorModel, response: ActuatorResponse, task: str) -> dict[str, float]:
    """Return the severities of a response, with that of wind-up, which the bench cannot see."""
    # The bench blocks the joint and holds the command, and wind-up shows when a command reverses.
    requested = severities(response, task)
    saturates = requested["supply"] > BENCH_ERROR and has_wind_up(actuator)
    return requested | ({WIND_UP: requested["supply"]} if saturates else {})


def predict_losses(
    evidence: Evidence, task: str, requested: Mapping[str, float]
) -> tuple[Loss, ...]:
    """Return the losses of policies trained on ideal forces, for each axis with study results."""
    return tuple(
        loss
        for axis, severity in requested.items()
        if (loss := evidence.loss(task, axis, severity)) is not None
    )


class TestedPoint(NamedTuple):
    """Loss of policies that were not trained on ideal forces, at some severities."""

    severities: Mapping[str, float]
    """Severity by axis; 0 on all others."""
    outcome: Outcome
    """Loss of each policy."""


class TestedArm(NamedTuple):
    """Tests of the policies of an arm, which bound the loss of an option."""

    upper: Sequence[TestedPoint]
    """Losses that the option does not exceed."""
    lower: Sequence[TestedPoint]
    """Losses below which the option does not come."""


TestedArms = Mapping[str, Sequence[TestedArm]]
"""Option -> arms."""


def option_bounds(
    evidence: Evidence,
    task: str,
    requested: Mapping[str, float],
    tests: TestedArms | None = None,
    least_lag: float | None = None,
) -> dict[str, LossBounds]:
    """Return the study's loss bounds by option, for given severities on all axes.

    A test at severities at least as large on every axis gives an upper bound. If the severity of a
    test is smaller on some axis, it also gives an upper bound after the loss of ideal-trained
    policies on that axis is added. A test at severities at most as large on every axis gives a
    lower bound. Between two tests of the same policies on one axis, losses are interpolated.

    Args:
        evidence: scores of the studies.
        task: task name.
        requested: severity by axis, and of `WIND_UP`.
        tests: result of `tested_arms`, if already computed.
        least_lag: smallest severity of the lag; None: the requested one.
    """
    losses = predict_losses(evidence, task, requested)
    lower_losses = losses
    if least_lag is not None and least_lag < 0.995 * requested["lag"] - BENCH_ERROR:
        lower_losses = predict_losses(evidence, task, {**requested, "lag": least_lag})
    upper_sum = lower_sum = sum_outcomes(loss.outcome for loss in losses)
    if any(loss.lower is not loss.outcome for loss in losses) or lower_losses is not losses:
        lower_sum = sum_outcomes(loss.lower for loss in lower_losses)
    is_bounded = len(losses) == len(requested) and not any(loss.beyond for loss in losses)
    options = {IDEAL: LossBounds(upper_sum if is_bounded else None, lower_sum)}
    for name, arms in (tested_arms(evidence, task) if tests is None else tests).items():
        upper = [
            bound
            for arm in arms
            for point in (*arm.upper, *_interpolated(arm.upper, requested))
            if (bound := _with_milder_axes(evidence, task, requested, point)) is not None
        ]
        lowers = [
            point.outcome
            for arm in arms
            for point in arm.lower
            if all(
                severity <= 1.005 * requested[axis] + BENCH_ERROR
                for axis, severity in point.severities.items()
            )
        ]
        options[name] = LossBounds(
            min(upper, key=lambda loss: (not loss.is_negligible, loss.loss.high), default=None),
            max(lowers, key=lambda loss: loss.loss.low, default=None),
        )
    return options


def _interpolated(
    points: Sequence[TestedPoint], requested: Mapping[str, float]
) -> Iterator[TestedPoint]:
    """Yield the point at the requested severity, if it lies between two tests on one axis."""
    axes = {axis for point in points for axis in point.severities}
    if len(points) < 2 or len(axes) > 1:
        return
    (axis,) = axes
    tested = sorted(points, key=lambda point: point.severities[axis])
    for low, high in itertools.pairwise(tested):
        span = high.severities[axis] - low.severities[axis]
        share = (requested[axis] - low.severities[axis]) / span
        if 0.0 < share < 1.0:
            yield TestedPoint(
                {axis: requested[axis]}, interpolate(low.outcome, high.outcome, share)
            )


def _with_milder_axes(
    evidence: Evidence, task: str, requested: Mapping[str, float], point: TestedPoint
) -> Outcome | None:
    """Return a test's loss, plus that of ideal-trained policies on axes where it was milder.

    The result is None if a severity exceeds all tested ones.
    """
    exceeding = {
        axis: severity
        for axis, severity in requested.items()
        if severity > 1.005 * point.severities.get(axis, 0.0) + BENCH_ERROR
    }
    extra = predict_losses(evidence, task, exceeding)
    if len(extra) < len(exceeding) or any(loss.beyond for loss in extra):
        return None
    if not extra:
        return point.outcome
    clipped = Outcome(*(np.maximum(part, 0.0) for part in point.outcome))
    return sum_outcomes([clipped, *(loss.outcome for loss in extra)])


def tested_arms(evidence: Evidence, task: str) -> TestedArms:
    """Return the tested arms that bound the loss of random actuators and of training through it.

    Policies trained at one severity and tested at another bound the loss of training through the
    tested one from above only. Policies trained on severities of one effect that are drawn for
    every episode score as high as those trained at the tested severity, within `MARGIN` (hypothesis
    P8 of docs/results/actuators.md, which was planned and holds), so that they bound it on both
    sides; the lower bound is one of scores only.
    """
    randomized, through = [], []
    for axis, definition in AXES.items():
        random = _points(axis, evidence.arm_curve(task, RANDOM, axis))
        randomized.append(TestedArm(random, random))
        matched = _points(axis, evidence.arm_curve(task, axis, axis))
        trained = definition.training_severity.get(task)
        at_training = [point for point in matched if point.severities[axis] == trained]
        drawn = _points(axis, evidence.arm_curve(task, f"{axis}, drawn", axis))
        lower = [
            TestedPoint(severity, Outcome(outcome.lost - MARGIN, 0.0 * outcome.missed))
            for severity, outcome in drawn
        ]
        through += [TestedArm(matched, at_training), TestedArm(drawn, lower)]
    for name, real in REAL.get(task, {}).items():
        if (outcome := evidence.outcome(task, name, name)) is not None:
            actuator = study_env(task, real).actuators[0]
            point = TestedPoint(severities(measure_on_task(actuator, task), task), outcome)
            through.append(TestedArm([point], [point]))
    return {RANDOMIZE: randomized, THROUGH: through}


def _points(axis: str, curve: Mapping[float, Outcome]) -> list[TestedPoint]:
    """Return the tests of a curve of losses over the severity of an axis."""
    return [TestedPoint({axis: severity}, outcome) for severity, outcome in curve.items()]


# -- text ------------------------------------------------------------------------------------------


def _reason(verdict: str, options: Mapping[str, LossBounds], response: ActuatorResponse) -> str:
    """Return the reason for a verdict as text, with everything that decides."""
    ideal_trained = options[IDEAL]
    control = ideal_trained.lower
    text = f"policies trained on ideal forces lose {describe(ideal_trained)}"
    others = {name: options[name] for name in OPTIONS if name in options and name != IDEAL}
    if verdict == IDEAL or control is None:
        return text
    if verdict == BUY:
        listed = [f"{name} {describe(option)}" for name, option in others.items()]
        return f"{text}; all other options lose too much: {', '.join(listed) or 'none'}" + "".join(
            f"; {name} wins {won.mean:.2f}, but every policy still fails"
            for name, option in others.items()
            if option.upper is not None
            and option.upper.failed == 1.0
            and (won := gains(option.upper, control, name in SAME_POLICIES)["loss"]).low > MARGIN
        )
    if verdict == MEASURE:
        return "; ".join([text, *_open_reasons(control, others)])
    detail = {
        COMMAND: f" (by {1.0 / max(response.at_rest, 0.1):.2f})",
        SENSOR: f" (filter or replace it: its noise is {response.noise:.2g} of the largest force)",
    }.get(verdict, "")
    chosen = options[verdict]
    option = "an exact current sensor" if verdict == SENSOR else "this option"
    text += f"; with {option}{detail} {describe(chosen)}"
    if chosen.upper is None or chosen.upper.is_negligible:
        return text
    decisive = [
        _describe_gain(name, gain)
        for name, gain in gains(chosen.upper, control, verdict in SAME_POLICIES).items()
        if gain.low > 0.0 and gain.mean > TOLERANCES[name]
    ]
    return f"{text}, certainly better by {' and '.join(decisive)}: buy another if that is too much"


def _open_reasons(control: Outcome, others: Mapping[str, LossBounds]) -> Iterator[str]:
    """Yield the reasons why no option is recommended."""
    if control.is_negligible:
        yield "the tests do not tell whether it is too much"
        for name, option in others.items():
            if option.upper is not None and option.upper.is_negligible:
                yield f"{name} ({describe(option)}) may not be needed"
        return
    untested = [name for name, option in others.items() if option.upper is None]
    if untested or not others:
        names = " and ".join(untested) or "any other option"
        yield f"{names} was not tested at this severity on this task"
    for name, option in others.items():
        if option.upper is not None:
            gained = gains(option.upper, control, name in SAME_POLICIES)
            text = ", ".join(_describe_gain(*gain) for gain in gained.items())
            yield f"{name} is not certainly better: it wins {text}"


def _describe_gain(measure: str, gain: Interval) -> str:
    """Return the 95 % interval of a difference as text."""
    if measure == "loss":
        return f"{gain.mean:z.2f} of the span ({gain.low:z.2f} to {gain.high:z.2f})"
    mean, low, high = (f"{100 * value:z.0f}" for value in gain)
    return f"{mean} % {'fewer' if measure == 'failures' else 'more'} {measure} ({low} to {high})"


def describe(option: LossBounds) -> str:
    """Return a loss with its 95 % interval, the number of failing policies and lost success."""
    outcome = option.upper or option.lower
    if outcome is None:
        return "an unknown share"
    mean, low, high = outcome.loss
    failed = f"{round(outcome.failed * len(outcome.lost))} of {len(outcome.lost)} fail"
    missed = outcome.success_lost.mean
    success = f"; {100 * missed:.0f} % less success" if missed > 0.005 else ""
    return f"{option.prefix}{mean:z.2f} of the span ({low:z.2f} to {high:z.2f}; {failed}{success})"


# -- measured --------------------------------------------------------------------------------------

RANDOM_EPISODES = 100
"""Episodes of random actions whose mean return is the span's lower end, outside the study."""


class Measurement(NamedTuple):
    """Trainings and tests that measure the loss on an actuator with each option."""

    grid: Grid
    """All trainings and tests."""
    baseline: Trial
    """Policies trained and tested on ideal forces."""
    options: Mapping[str, Trial]
    """Option -> test of its policies, on the actuator or on the same motor with a designed loop."""

    def loss_bounds(self, collected: StudyResults) -> dict[str, LossBounds]:
        """Return the loss by option, for `decide`; the task's span is treated as exact.

        Raises:
            ValueError: a result is missing, or the baseline is no better than random actions.
        """
        if collected.missing:
            reason = next((f": {name}: {error}" for name, error in collected.failures.items()), "")
            raise ValueError(
                f"{len(collected.missing)} of the measurement's trainings and tests are"
                f" missing{reason}: run it again"
            )
        env = self.baseline.env
        floor = FLOORS.get(env.task) if self.baseline.arm == _baseline_arm(env.task) else None
        if floor is None:
            floor = evaluate(RandomPolicy(env.action_space), env, RANDOM_EPISODES).returns.mean
        scores = Scores(collected, {env.task: floor}, [self.baseline])
        succeeded = _values(collected, self.baseline, "success")
        if not scores.ceilings:
            raise ValueError(
                f"{env.task}: ideal-trained policies are no better than random actions: train more"
                " seeds"
            )
        options = {}
        for name, trial in self.options.items():
            lost = 1.0 - np.array(list(scores.by_seed(trial).values()))
            missed = (
                np.mean(succeeded) - _values(collected, trial, "success")
                if len(succeeded)
                else 0.0 * lost
            )
            options[name] = LossBounds(outcome := Outcome(lost, missed), outcome)
        return options


def plan_measurement(
    actuator: StoredActuators | ActuatorSetting,
    subject: str,
    seeds: int,
    root: Path,
    episodes: int = 50,
    trust: bool = False,
) -> Measurement:
    """Plan the trainings and tests that compare all options for an actuator.

    Args:
        actuator: anything that `EnvConfig.actuator` accepts.
        subject: a task, the Gymnasium id of a third-party environment, or a run folder, whose
            environment, agent and training budget are reused.
        seeds: number of training runs for each option, at least 2.
        root: folder of the run folders.
        episodes: test episodes of each policy.
        trust: True to import, and thereby execute, the modules that a run folder names.

    Raises:
        ValueError: fewer than 2 seeds, or the actuator is ideal.
    """
    if seeds < 2:
        raise ValueError(f"seeds = {seeds}: an interval needs at least 2")
    base = _baseline_arm(subject, trust)
    # The ideal environment is reused unchanged, so that policies are judged by their own reward.
    ideal_env = base.config.env
    env_on_actuator = dataclasses.replace(ideal_env, actuator=actuator)
    if all(motor_actuator == IDEAL_ACTUATOR for motor_actuator in env_on_actuator.actuators):
        raise ValueError(
            "actuator = 'ideal': there is no loss to measure on ideal forces; name another actuator"
        )
    env = dataclasses.replace(base.config.env, actuator=actuator)
    through_arm = Arm(
        f"{base.task}: through it", dataclasses.replace(base.config, env=env), base.seconds
    )
    options = {IDEAL: Trial(base, "it", env_on_actuator)}
    # The loop design and the random lag are defined for a single actuator.
    if "timestep" in env_on_actuator.source.fields and len(env_on_actuator.actuators) == 1:
        (single,) = env_on_actuator.actuators
        for name, test, improved in (
            (LOOP, "designed", redesign_loop(single, base.task)),
            (SENSOR, "exact sensor", fix_sensor(single)),
        ):
            if improved is not None:
                options[name] = Trial(base, test, dataclasses.replace(ideal_env, actuator=improved))
        options[RANDOMIZE] = Trial(
            random_arm(base, random_ranges(base.task)), "it", env_on_actuator
        )
    options[THROUGH] = Trial(through_arm, "it", env_on_actuator)
    baseline = Trial(base, "ideal", ideal_env)
    return Measurement(
        Grid(root, (baseline, *options.values()), lambda _: range(seeds), episodes),
        baseline,
        options,
    )


def _baseline_arm(subject: str, trust: bool = False) -> Arm:
    """Return the arm trained on ideal forces: of the study, of a run, or of a default agent."""
    if subject in SECONDS:
        return ideal_arm(subject)
    if (Path(subject) / "config.json").is_file():
        config = load_config(Path(subject), trust)
    else:
        config = TrainConfig.preset(subject, default_agent(subject))
    # Evaluations and checkpoints during training would only cost time.
    never = max(config.total_steps or 10**9, 10**9)
    env = dataclasses.replace(
        config.env, actuator=IDEAL_ACTUATOR, randomize=None, allow_unstable=False
    )
    config = dataclasses.replace(
        config, env=env, seed=0, evaluation_interval=never, checkpoint_interval=never
    )
    return Arm(f"{config.task}: ideal", config, 60.0)


def _values(collected: StudyResults, trial: Trial, measure: str) -> np.ndarray:
    """Return a measure of all policies of a trial as an array."""
    return np.array(list(collected.scores(trial, measure).values()))
