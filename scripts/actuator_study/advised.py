"""Accuracy of `codrl-mj advise` on all tested actuators and severities, each without its tests."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from actuator_study import arms
from actuator_study.exploration import paper_loops, wound_up
from codrl_mj.study.advice import (
    BUY,
    IDEAL,
    LOOP,
    MEASURE,
    RANDOM,
    RANDOMIZE,
    SENSOR,
    THROUGH,
    advise,
    decide,
    option_bounds,
)
from codrl_mj.study.axes import AXES, SECONDS, study_env
from codrl_mj.study.evidence import Evidence, LossBounds
from codrl_mj.study.questions import MARGIN

WINDING, PAPER = ", winding up", "paper, "
"""Parts of the names of tests: of drives without anti-windup, and of variants of the paper's loop."""

KINDS = ("motors and loops", "variants of the paper's loop", "drives without anti-windup")
"""Kinds of actuators that were tested, besides single severities."""


def tested(task: str) -> dict[str, tuple[str, Any]]:
    """Return the label and the actuator of each test that is not a severity of a single axis."""
    motors = {"good motor": arms.GOOD[task]} | (
        {"marginal motor": arms.MARGINAL[task]} if task in arms.MARGINAL else {}
    )
    called = {
        test: (motor_name(motor), study_env(task, motor).actuator) for test, motor in motors.items()
    }
    if task in arms.LOOPED:
        loops = {loop: arms.designed(task) if loop == "designed" else loop for loop in LOOPS}
        called |= {
            loop: (f"paper's motor, {loop} loop", study_env(task, loop_actuator).actuator)
            for loop, loop_actuator in loops.items()
        }
        # The variants of the integration step have the same actuator.
        called |= {
            f"{PAPER}{variant}": (f"paper's motor, {variant}", env.actuator)
            for variant, env in paper_loops(task).items()
            if "step" not in variant
        }
    return called | {
        f"supply {severity:g}{WINDING}": (
            f"{100 * severity:.0f} % of the voltage missing, no anti-windup",
            wound_up(task, severity).actuator,
        )
        for severity in AXES["supply"].severities[1:]
    }


LOOPS = ("weaker", "paper", "designed")
"""Loops around the paper's motor that were tested."""


def motor_name(motor: Mapping[str, Any]) -> str:
    """Return a motor's name with its gear, and its supply voltage if that is not nominal."""
    volts = f", {motor['supply']['voltage']:g} V" if "supply" in motor else ""
    return f"{motor['name']}, {motor['motor']['gear_ratio']:g}:1{volts}"


def kind(test: str) -> str:
    """Return the kind of actuator of a test: one of `KINDS`."""
    return KINDS[2] if test.endswith(WINDING) else KINDS[1] if test.startswith(PAPER) else KINDS[0]


def left_out_tests(test: str) -> tuple[str, ...]:
    """Return the tests that advice on an actuator must predict: its own, and near copies."""
    return (test, *LOOPS) if test.startswith(PAPER) else (test,)


def measured(evidence: Evidence, task: str, test: str) -> dict[str, LossBounds]:
    """Return the measured loss of policies on an actuator, by training option."""
    trained = {IDEAL: ("ideal", test), THROUGH: (test, test)}
    if test in ("weaker", "paper") or test.startswith(PAPER):
        trained[LOOP] = ("ideal", "designed")
    elif test.endswith(WINDING):
        trained[LOOP] = ("ideal", test.removesuffix(WINDING))
    return _bounds(evidence, task, trained, "ideal")


def measured_at(evidence: Evidence, task: str, axis: str, severity: float) -> dict[str, LossBounds]:
    """Return the measured loss of policies at a severity of one axis, by training option."""
    test = f"{axis} {severity:g}"
    without = f"{axis} 0" if AXES[axis].motor_at_zero else "ideal"
    trained = {IDEAL: ("ideal", test), RANDOMIZE: (RANDOM, test)}
    if axis == "noise":
        trained[SENSOR] = ("ideal", without)
    if AXES[axis].training_severity.get(task) == severity:
        trained[THROUGH] = (axis, test)
    return _bounds(evidence, task, trained, without)


def _bounds(
    evidence: Evidence, task: str, trained: Mapping[str, tuple[str, str]], reference: str
) -> dict[str, LossBounds]:
    """Return the measured losses of options, given as (arm, test)."""
    outcomes = {
        name: evidence.outcome(task, arm, deployed, reference if arm == "ideal" else None)
        for name, (arm, deployed) in trained.items()
    }
    return {
        name: LossBounds(outcome, outcome)
        for name, outcome in outcomes.items()
        if outcome is not None
    }


def judged(verdict: str, options: Mapping[str, LossBounds]) -> str:
    """Judge a verdict by the measured losses and the rule of `decide`.

    It is right if its option is what the rule recommends of it and of doing nothing: a remedy
    where nothing is lost is wrong.
    """
    if verdict == MEASURE:
        return "says nothing"
    if verdict == BUY:
        return "right" if decide(options) == BUY else "wrong"
    if verdict not in options:
        return "not tested"
    return (
        "right"
        if decide({IDEAL: options[IDEAL], verdict: options[verdict]}) == verdict
        else "wrong"
    )


def rows(evidence: Evidence) -> Iterator[dict[str, Any]]:
    """Yield a row for each actuator and task: predicted loss, measured loss, verdict, judgment."""
    for task in SECONDS:
        for test, (name, actuator) in tested(task).items():
            options = measured(evidence, task, test)
            # The actuator's own tests are removed, so that advice has to predict them.
            advice = advise(actuator, task, evidence.without(*left_out_tests(test)))
            if IDEAL not in options or not advice.options:
                continue
            bounds, outcome = advice.options[IDEAL], options[IDEAL].lower
            predicted = bounds.upper or bounds.lower
            assert predicted is not None
            assert outcome is not None
            decided = decide(options)
            yield {
                "task": task,
                "actuator": name,
                "kind": kind(test),
                "beyond": bounds.upper is None,
                "at_most": bounds.upper is not None and bounds.upper is not bounds.lower,
                **{f"predicted_{key}": value for key, value in predicted.loss._asdict().items()},
                **{f"measured_{key}": value for key, value in outcome.loss._asdict().items()},
                "measured_failed": outcome.failed,
                "measured_success_lost": outcome.success_lost.mean,
                "said": advice.verdict,
                # Where nothing was trained through it, another motor may not be needed.
                "measured": (
                    decided
                    if THROUGH in options or decided not in (BUY, MEASURE)
                    else "not trained through"
                ),
                "judged": judged(advice.verdict or MEASURE, options),
            }


def severity_judgments(evidence: Evidence) -> Iterator[tuple[str, str]]:
    """Yield (verdict, judgment) for each tested severity, predicted without its tests."""
    for task in SECONDS:
        for axis, known in AXES.items():
            for severity in known.severities[1:]:
                options = measured_at(evidence, task, axis, severity)
                remaining = evidence.without(f"{axis} {severity:g}")
                requested = dict.fromkeys(AXES, 0.0) | {axis: severity}
                if IDEAL not in options or remaining.loss(task, axis, severity) is None:
                    continue
                bounds = option_bounds(remaining, task, requested)
                # At a severity of noise, an exact sensor leaves nothing.
                if axis == "noise":
                    none = dict.fromkeys(AXES, 0.0)
                    bounds[SENSOR] = option_bounds(remaining, task, none, {})[IDEAL]
                verdict = decide(bounds)
                yield verdict, judged(verdict, options)


def left_out(evidence: Evidence) -> dict[str, float]:
    """Predict each inner severity from its neighbors; return errors and number of flipped verdicts."""
    errors, flips = [], 0
    for task in SECONDS:
        for axis, known in AXES.items():
            # The first and the last severity have a neighbor on one side only.
            for severity in known.severities[1:-1]:
                loss = evidence.loss(task, axis, severity)
                expected = evidence.without(f"{axis} {severity:g}").loss(task, axis, severity)
                if loss is not None and expected is not None:
                    errors.append(abs(loss.outcome.loss.mean - expected.outcome.loss.mean))
                    flips += loss.outcome.is_negligible != expected.outcome.is_negligible
    return {
        "severities": len(errors),
        "mean_error": float(np.mean(errors or [0.0])),
        "off": int(np.sum(np.array(errors) > MARGIN)),
        "flips": flips,
    }
