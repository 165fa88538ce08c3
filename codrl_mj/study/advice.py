"""Recommendation for an actuator on a task, from a simulated bench test and the study's results.

The bench test gives the actuator a severity on each axis of the study. The loss of policies trained
on ideal forces is interpolated, policy by policy, between the severities that the study tested, and
the losses of all axes are added. For policies trained on random actuators or through the actuator,
a study's test gives an upper bound if its severities are at least as large on every axis, and a
lower bound if they are at most as large. A `Measurement` needs none of these assumptions: it trains
and tests new policies, in any environment, and applies the same rule (`decide`).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import IDEAL as IDEAL_ACTUATOR
from codrl_mj.actuators import ActuatorModel, ActuatorSetting
from codrl_mj.envs.config import StoredActuators
from codrl_mj.evaluation import RandomPolicy, evaluate
from codrl_mj.study.axes import AXES, FLOORS, REAL, SECONDS, generic_arm, ideal_arm, study_env
from codrl_mj.study.bench import (
    ActuatorResponse,
    measure_on_task,
    measure_with_larger_command,
    redesign_loop,
    severities,
)
from codrl_mj.study.evidence import Evidence, Loss, LossBounds, Outcome, sum_outcomes
from codrl_mj.study.questions import MARGIN, Scores
from codrl_mj.study.trials import Arm, Grid, StudyResults, Trial
from codrl_mj.training import TrainConfig, load_config
from codrl_mj.training.config import default_agent

IDEAL, COMMAND, LOOP = "train on ideal", "command more", "design the loop"
RANDOMIZE, THROUGH = "randomise", "train through it"
BUY, MEASURE = "buy another", "measure it"
RANDOM = ("generic", "random")
"""Arms trained on random actuators: one in each of the two studies, with different ranges."""
OPTIONS = (IDEAL, COMMAND, LOOP, RANDOMIZE, THROUGH)
"""Options for an actuator, in order of effort. The other two verdicts are `BUY` and `MEASURE`."""


def decide(options: Mapping[str, LossBounds]) -> str:
    """Return the recommended option; the rule is the same for predicted and measured losses.

    1. The first of `OPTIONS` whose loss is negligible.
    2. Otherwise consider the options that are certainly better than training on ideal forces, by
       more than `MARGIN`, and return the first whose mean is within `MARGIN` of the best of them.
    3. Otherwise `BUY` if every option is certainly harmful and all options except training on ideal
       forces have a known upper bound.
    4. Otherwise `MEASURE`.
    """
    known_options = {name: options[name] for name in OPTIONS if name in options}
    for name, option in known_options.items():
        if option.upper is not None and option.upper.is_negligible:
            return name
    ideal_trained = known_options[IDEAL].lower
    upper = {
        name: option.upper.loss
        for name, option in known_options.items()
        if option.upper is not None
    }
    better = [
        name
        for name in upper
        if ideal_trained is not None and upper[name].high < ideal_trained.loss.low - MARGIN
    ]
    if better:
        best = min(upper[name].mean for name in better)
        return next(name for name in better if upper[name].mean <= best + MARGIN)
    # An option without an upper bound is untested and might still be good enough.
    alternatives = (option.upper for name, option in known_options.items() if name != IDEAL)
    all_harmful = all(
        option.lower is not None and option.lower.is_harmful for option in known_options.values()
    )
    return BUY if all_harmful and None not in alternatives else MEASURE


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

    def summary(self) -> dict[str, object]:
        """Return the fields under the keys of the command line's JSON output."""
        names = {"response": "found"}
        return {names.get(name, name): value for name, value in self._asdict().items()}


def advise(actuator: ActuatorModel, task: str, evidence: Evidence) -> Advice:
    """Recommend an option for a force-controlled actuator on a task from the study's results."""
    response = measure_on_task(actuator, task)
    losses = predict_losses(evidence, task, severities(response, task))
    if len(losses) < len(AXES):
        return Advice(
            task,
            response,
            (),
            {},
            None,
            "no results of the study are available for this task: measure it",
        )
    redesigned = redesign_loop(actuator, task)
    boosted = measure_with_larger_command(actuator, task, response)
    options = option_bounds(evidence, task, severities(response, task))
    for name, improved in (
        (LOOP, None if redesigned is None else measure_on_task(redesigned, task)),
        (COMMAND, boosted),
    ):
        if improved is not None:
            options[name] = _bounds_of_losses(
                predict_losses(evidence, task, severities(improved, task))
            )
    # The study has no axis for excess force or for an offset, so that it predicts no loss for them.
    untested = ""
    if max(response.at_rest, response.at_speed) > 1.0 + MARGIN:
        untested = "it delivers more force than commanded"
    # The mean of correlated noise samples stays below half their standard deviation, so that noise
    # alone does not count as an offset.
    if response.unasked > max(0.02, response.noise / 2.0):
        untested = f"it delivers {response.unasked:.2g} of the largest force at a command of zero"
    if untested:
        return Advice(task, response, losses, options, MEASURE, f"{untested}, which was not tested")
    verdict = decide(options)
    return Advice(task, response, losses, options, verdict, _reason(verdict, options, response))


def predict_losses(
    evidence: Evidence, task: str, requested: Mapping[str, float]
) -> tuple[Loss, ...]:
    """Return the losses of policies trained on ideal forces, for each axis with study results."""
    return tuple(
        loss
        for axis, severity in requested.items()
        if (loss := evidence.loss(task, axis, severity)) is not None
    )


def _bounds_of_losses(losses: Sequence[Loss]) -> LossBounds:
    """Return the sum of losses; it has no upper bound if a severity exceeds all tested ones."""
    outcome = sum_outcomes(loss.outcome for loss in losses)
    return LossBounds(None if any(loss.beyond for loss in losses) else outcome, outcome)


TestedPoints = Mapping[str, Sequence[tuple[Mapping[str, float], Outcome]]]
"""Option -> tests, each as (axis -> severity, loss)."""


def option_bounds(
    evidence: Evidence, task: str, requested: Mapping[str, float], tests: TestedPoints | None = None
) -> dict[str, LossBounds]:
    """Return the study's loss bounds by option, for given severities on all axes.

    A test at severities at least as large on every axis gives an upper bound. If the severity of a
    test is smaller on some axis, it also gives an upper bound after the loss of ideal-trained
    policies on that axis is added. A test at severities at most as large on every axis gives a
    lower bound.

    Args:
        evidence: scores of the studies.
        task: task name.
        requested: severity by axis.
        tests: result of `tested_points`, if already computed.
    """
    # Severities are compared with a tolerance of 0.5 %, because the bench measures them with a
    # finite time step.
    options = {IDEAL: _bounds_of_losses(predict_losses(evidence, task, requested))}
    for name, points in (tests or tested_points(evidence, task)).items():
        upper, lower = [], []
        for tested, outcome in points:
            exceeding = {
                axis: severity
                for axis, severity in requested.items()
                if severity > 1.005 * tested.get(axis, 0.0) + 1e-9
            }
            # On axes where the test was milder than requested, the loss of ideal-trained policies
            # is added.
            extra = predict_losses(evidence, task, exceeding)
            if not any(loss.beyond for loss in extra):
                clipped = (
                    Outcome(*(np.maximum(part, 0.0) for part in outcome)) if extra else outcome
                )
                upper.append(sum_outcomes([clipped, *(loss.outcome for loss in extra)]))
            if all(severity <= 1.005 * requested[axis] + 1e-9 for axis, severity in tested.items()):
                lower.append(outcome)
        lowest_upper = min(
            upper, key=lambda loss: (not loss.is_negligible, loss.loss.high), default=None
        )
        options[name] = LossBounds(
            lowest_upper, max(lower, key=lambda loss: loss.loss.low, default=None)
        )
    return options


def tested_points(evidence: Evidence, task: str) -> TestedPoints:
    """Return option -> (tested severities, loss) of policies not trained on ideal forces."""
    all_tests = [
        (f"{axis} {severity:g}", {axis: severity})
        for axis, definition in AXES.items()
        for severity in definition.severities[1:]
    ]
    training = {
        axis: definition.training_severity[task]
        for axis, definition in AXES.items()
        if task in definition.training_severity
    }
    tests: dict[str, list[tuple[str, str, dict[str, float]]]] = {
        RANDOMIZE: [(arm, *test) for arm in RANDOM for test in all_tests],
        THROUGH: [
            (axis, f"{axis} {severity:g}", {axis: severity}) for axis, severity in training.items()
        ],
    }
    for name, real in REAL.get(task, {}).items():
        if evidence.outcome(task, name, name) is not None:
            tests[THROUGH].append(
                (
                    name,
                    name,
                    severities(measure_on_task(study_env(task, real).actuators[0], task), task),
                )
            )
    return {
        option: [
            (tested, outcome)
            for arm, test, tested in candidates
            if (outcome := evidence.outcome(task, arm, test)) is not None
        ]
        for option, candidates in tests.items()
    }


# -- text ------------------------------------------------------------------------------------------


def _reason(verdict: str, options: Mapping[str, LossBounds], response: ActuatorResponse) -> str:
    """Return the reason for a verdict as text."""
    ideal_trained = options[IDEAL]
    text = f"policies trained on ideal forces lose {describe(ideal_trained)}"
    if verdict in (IDEAL, BUY):
        alternatives = ", ".join(
            f"{name} {describe(option)}" for name, option in options.items() if name != IDEAL
        )
        return (
            text
            if verdict == IDEAL
            else f"{text}; all other options lose too much: {alternatives or 'none'}"
        )
    if verdict == MEASURE:
        untested = [
            name for name, option in options.items() if option.upper is None and name != IDEAL
        ]
        return (
            f"{text}; {' and '.join(untested) or 'any other option'} was not tested at this"
            " severity on this task"
        )
    factor = f" by {1.0 / response.at_rest:.2f}" if verdict == COMMAND else ""
    chosen = options[verdict]
    caveat = (
        ""
        if chosen.upper is not None and chosen.upper.is_negligible
        else ": buy another if that is too much"
    )
    return f"{text}; with this option{factor} {describe(chosen)}{caveat}"


def describe(option: LossBounds) -> str:
    """Return a loss with its 95 % interval and the number of failing policies as text."""
    outcome = option.upper or option.lower
    if outcome is None:
        return "an unknown share"
    mean, low, high = outcome.loss
    failed = f"{round(outcome.failed * len(outcome.lost))} of {len(outcome.lost)} fail"
    return f"{option.prefix}{mean:z.2f} of the span ({low:z.2f} to {high:z.2f}; {failed})"


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
        redesigned = redesign_loop(env_on_actuator.actuators[0], base.task)
        if redesigned is not None:
            options[LOOP] = Trial(
                base, "designed", dataclasses.replace(ideal_env, actuator=redesigned)
            )
        options[RANDOMIZE] = Trial(generic_arm(base), "it", env_on_actuator)
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
