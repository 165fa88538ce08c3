"""How right `codrl-mj advise` is: what it says of every actuator that was tested, without that actuator's own tests."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from actuator_study import arms
from codrl_mj.study.advice import BUY, IDEAL, LOOP, MEASURE, THROUGH, LossBounds, advise, decide
from codrl_mj.study.axes import AXES, SECONDS, study_env
from codrl_mj.study.evidence import Evidence
from codrl_mj.study.questions import MARGIN


def tested(task: str) -> dict[str, tuple[str, Any]]:
    """Test -> what to call the actuator, and the actuator, of all that are none of the doses."""
    found = {"good motor": arms.GOOD[task]} | (
        {"marginal motor": arms.MARGINAL[task]} if task in arms.MARGINAL else {}
    )
    called = {
        test: (motor_name(motor), study_env(task, motor).actuator) for test, motor in found.items()
    }
    if task not in arms.LOOPED:
        return called
    loops = {loop: arms.designed(task) if loop == "designed" else loop for loop in LOOPS}
    return called | {
        loop: (f"paper's motor, {loop} loop", study_env(task, one).actuator)
        for loop, one in loops.items()
    }


LOOPS = ("weaker", "paper", "designed")
"""Loops around the paper's motor that were tested."""


def motor_name(motor: Mapping[str, Any]) -> str:
    """A motor of the catalogue with its gear, and its supply where that is not the nominal one."""
    volts = f", {motor['supply']['voltage']:g} V" if "supply" in motor else ""
    return f"{motor['name']}, {motor['motor']['gear_ratio']:g}:1{volts}"


def measured(evidence: Evidence, task: str, test: str) -> dict[str, LossBounds]:
    """What policies lost on an actuator, by what was done."""
    trained = {IDEAL: ("ideal", test), THROUGH: (test, test)}
    if test in ("weaker", "paper"):
        trained[LOOP] = ("ideal", "designed")
    outcomes = {
        name: evidence.outcome(task, arm, there, "ideal" if arm == "ideal" else None)
        for name, (arm, there) in trained.items()
    }
    return {
        name: LossBounds(outcome, outcome)
        for name, outcome in outcomes.items()
        if outcome is not None
    }


def judged(said: str, options: Mapping[str, LossBounds]) -> str:
    """Whether a verdict is right: what it says to do loses nothing, or surely less than doing nothing."""
    if said == MEASURE:
        return "says nothing"
    if said == BUY:
        return "right" if decide(options) == BUY else "wrong"
    if said not in options:
        return "not tested"
    return "right" if decide({IDEAL: options[IDEAL], said: options[said]}) == said else "wrong"


def rows(evidence: Evidence) -> Iterator[dict[str, Any]]:
    """A row for every actuator and task: losses that were predicted and measured, what is said, and whether rightly."""
    for task in SECONDS:
        for test, (name, actuator) in tested(task).items():
            options = measured(evidence, task, test)
            found = advise(actuator, task, evidence.without(test))
            if IDEAL not in options or not found.options:
                continue
            predicted, seen = found.options[IDEAL].lower, options[IDEAL].lower
            assert predicted is not None
            assert seen is not None
            yield {
                "task": task,
                "actuator": name,
                "beyond": found.options[IDEAL].upper is None,
                **{f"predicted_{key}": value for key, value in predicted.loss._asdict().items()},
                **{f"measured_{key}": value for key, value in seen.loss._asdict().items()},
                "measured_failed": seen.failed,
                "measured_success_lost": seen.success_lost.mean,
                "said": found.verdict,
                "measured": (
                    decide(options) if THROUGH in options or seen.is_negligible else "not trained through"
                ),
                "judged": judged(found.verdict or MEASURE, options),
            }


def left_out(evidence: Evidence) -> dict[str, float]:
    """Every dose but none and the largest, predicted from its neighbours: how far off, and what of it matters."""
    errors, flips = [], 0
    for task in SECONDS:
        for axis, known in AXES.items():
            for dose in known.severities[1:-1]:
                seen = evidence.loss(task, axis, dose)
                expected = evidence.without(f"{axis} {dose:g}").loss(task, axis, dose)
                if seen is not None and expected is not None:
                    errors.append(abs(seen.outcome.loss.mean - expected.outcome.loss.mean))
                    flips += seen.outcome.is_negligible != expected.outcome.is_negligible
    return {
        "doses": len(errors),
        "mean_error": float(np.mean(errors or [0.0])),
        "off": int(np.sum(np.array(errors) > MARGIN)),
        "flips": flips,
    }
