"""Accuracy of `codrl-mj advise` on every tested actuator, without that actuator's own tests."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from actuator_study import arms
from codrl_mj.study.advice import BUY, IDEAL, LOOP, MEASURE, THROUGH, advise, decide
from codrl_mj.study.axes import AXES, SECONDS, study_env
from codrl_mj.study.evidence import Evidence, LossBounds
from codrl_mj.study.questions import MARGIN


def tested(task: str) -> dict[str, tuple[str, Any]]:
    """Return the label and the actuator of each test that is not a severity of a single axis."""
    motors = {"good motor": arms.GOOD[task]} | (
        {"marginal motor": arms.MARGINAL[task]} if task in arms.MARGINAL else {}
    )
    called = {
        test: (motor_name(motor), study_env(task, motor).actuator) for test, motor in motors.items()
    }
    if task not in arms.LOOPED:
        return called
    loops = {loop: arms.designed(task) if loop == "designed" else loop for loop in LOOPS}
    return called | {
        loop: (f"paper's motor, {loop} loop", study_env(task, loop_actuator).actuator)
        for loop, loop_actuator in loops.items()
    }


LOOPS = ("weaker", "paper", "designed")
"""Loops around the paper's motor that were tested."""


def motor_name(motor: Mapping[str, Any]) -> str:
    """Return a motor's name with its gear, and its supply voltage if that is not nominal."""
    volts = f", {motor['supply']['voltage']:g} V" if "supply" in motor else ""
    return f"{motor['name']}, {motor['motor']['gear_ratio']:g}:1{volts}"


def measured(evidence: Evidence, task: str, test: str) -> dict[str, LossBounds]:
    """Return the measured loss of policies on an actuator, by training option."""
    trained = {IDEAL: ("ideal", test), THROUGH: (test, test)}
    if test in ("weaker", "paper"):
        trained[LOOP] = ("ideal", "designed")
    outcomes = {
        name: evidence.outcome(task, arm, deployed, "ideal" if arm == "ideal" else None)
        for name, (arm, deployed) in trained.items()
    }
    return {
        name: LossBounds(outcome, outcome)
        for name, outcome in outcomes.items()
        if outcome is not None
    }


def judged(verdict: str, options: Mapping[str, LossBounds]) -> str:
    """Judge a verdict: right if its option loses nothing, or surely less than doing nothing."""
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
            advice = advise(actuator, task, evidence.without(test))
            if IDEAL not in options or not advice.options:
                continue
            predicted, outcome = advice.options[IDEAL].lower, options[IDEAL].lower
            assert predicted is not None
            assert outcome is not None
            yield {
                "task": task,
                "actuator": name,
                "beyond": advice.options[IDEAL].upper is None,
                **{f"predicted_{key}": value for key, value in predicted.loss._asdict().items()},
                **{f"measured_{key}": value for key, value in outcome.loss._asdict().items()},
                "measured_failed": outcome.failed,
                "measured_success_lost": outcome.success_lost.mean,
                "said": advice.verdict,
                "measured": (
                    decide(options)
                    if THROUGH in options or outcome.is_negligible
                    else "not trained through"
                ),
                "judged": judged(advice.verdict or MEASURE, options),
            }


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
