"""What is wrong with a log before anything is fitted to it: each finding with its row and a remedy."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from codrl_mj.identify.contradictions import contradictions
from codrl_mj.identify.log import LONGEST_STEP, SIGNALS, Finding, Log

_DROPPED = 1.5  # median steps, from which on rows are missing
_MOST_LISTED = 10
_SAW = ("current", "torque", "velocity")  # signals that a sensor may clip or spoil; others rest where they like

_MOST = {"voltage": 1e3, "bus": 1e3, "current": 1e3, "velocity": 2e4, "torque": 1e4}
"""In SI: beyond the largest motors of robots, and beyond 190,000 rpm."""


def check(log: Log, motor: Any = None, rig: str | None = None) -> list[Finding]:
    """What is noteworthy about a log, errors first; beside a datasheet's `GearMotor` and on a rig, where given."""
    findings = [*log.findings, *_times(log)]
    for signal in log.signals:
        findings += _resolution(log, signal)
        if signal in _SAW:
            findings += [*_saturation(log, signal), *_outliers(log, signal)]
    findings += [*_wrapped(log), *_implausible(log, motor), *contradictions(log, motor, rig)]
    order = ("error", "warning", "info")
    return sorted(findings, key=lambda one: order.index(one.severity))


def _times(log: Log) -> Iterator[Finding]:
    """Gaps, dropped rows, jitter, and stamps in another unit."""
    steps, usual, rows = np.diff(log.time), log.step, log.row_numbers
    gaps = np.flatnonzero(steps > LONGEST_STEP * usual)
    for place in gaps[:_MOST_LISTED]:
        text = f"a gap of {steps[place]:.4g} s after {log.time[place]:.4g} s, {steps[place] / usual:.0f} usual steps"
        yield Finding("warning", "gap", int(rows[place + 1]), text, "nothing is simulated across it")
    if gaps.size > _MOST_LISTED:
        yield Finding("warning", "gap", None, f"{gaps.size - _MOST_LISTED} more gaps", "see the first ones")
    dropped = np.flatnonzero((steps > _DROPPED * usual) & (steps <= LONGEST_STEP * usual))
    if dropped.size:
        missing = int(np.sum(np.round(steps[dropped] / usual) - 1.0))
        share = missing / (len(log.time) + missing)
        text = f"{missing} rows missing ({share:.2g} of all) in {dropped.size} places, the first one here"
        remedy = "keep the stamps: they are gone by; as if the rows were uniform, the fit would be wrong"
        severity = "warning" if share > 0.01 else "info"
        yield Finding(severity, "dropped rows", int(rows[dropped[0] + 1]), text, remedy)
    regular = steps[steps <= _DROPPED * usual]
    jitter = float(np.std(regular)) / usual
    if jitter > 0.02:
        worst = int(np.argmax(np.where(steps <= _DROPPED * usual, np.abs(steps - usual), 0.0)))
        text = f"steps of {regular.min():.3g} to {regular.max():.3g} s about {usual:.3g} s, {jitter:.0%} of it"
        remedy = "take each stamp when the values are read"
        yield Finding("warning" if jitter > 0.3 else "info", "jitter", int(rows[worst + 1]), text, remedy)
    if not 2e-6 <= usual <= 0.5:
        text = f"a row every {usual:.3g} s is unusual: is the time in another unit?"
        yield Finding("error", "unit", None, text, "write time=column:ms, or us, or ns")


def _resolution(log: Log, signal: str) -> Iterator[Finding]:
    """A quantisation that is coarse beside what the signal does."""
    step, values, unit = log.resolution.get(signal, 0.0), log.signals[signal], SIGNALS[signal] or ""
    if step == 0.0 or signal in ("command", "temperature", "duty", "voltage", "bus"):
        return
    spread = float(np.ptp(values))
    coarse = spread < 100.0 * step if signal == "position" else step > 0.1 * float(np.std(values))
    if not coarse:
        return
    text = f"{signal} is known to {step:.3g} {unit} and spans {spread:.3g} {unit}, {spread / step:.0f} steps"
    remedy = {
        "position": "move further, or use a finer encoder",
        "velocity": "leave it out and give the position, or smooth it over several ms and give that",
    }.get(signal, "measure in a smaller range, or drive harder")
    yield Finding("warning", "resolution", None, text, remedy)


def _saturation(log: Log, signal: str) -> Iterator[Finding]:
    """Values that pile up at the highest or the lowest one, as a clipped signal's do."""
    values = log.signals[signal]
    spread = float(np.ptp(values))
    for name, bound in (("highest", float(values.max())), ("lowest", float(values.min()))):
        away = np.abs(values - bound)
        near = max(0.05 * spread, 3.5 * log.resolution.get(signal, 0.0))
        at, beside = away <= 1e-6 * spread, (away > 1e-6 * spread) & (away <= near)
        # flat tops in the middle of motion; a signal that rests at 0 is not clipped there
        if at.sum() >= 10 and at.sum() > 3 * beside.sum() and abs(bound) > 0.2 * spread:
            row = int(log.row_numbers[np.flatnonzero(at)[0]])
            text = f"{int(at.sum())} rows are at the {name} {signal}, {bound:.4g} {SIGNALS[signal]}, the first one here"
            remedy = "if the sensor is clipped there, measure in a larger range, or leave these rows out with only="
            yield Finding("warning", "saturation", row, text, remedy)


def _outliers(log: Log, signal: str) -> Iterator[Finding]:
    """Single rows that leave both neighbours by much more than others do."""
    values = log.signals[signal]
    if len(values) < 50:
        return
    before, after = np.diff(values)[:-1], np.diff(values)[1:]
    height = np.where(before * after < 0.0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    if log.has("voltage"):  # where that jumps, the current may have a peak
        jumps = np.abs(np.diff(log.signals["voltage"])) > 0.05 * float(np.ptp(log.signals["voltage"]))
        near = np.convolve(jumps, np.ones(5), mode="same") > 0.0
        height[near[:-1] | near[1:]] = 0.0
    peaks = height[height > 0.0]
    if peaks.size < 10:
        return
    bound = max(5.0 * float(np.quantile(peaks, 0.8)), 4.0 * log.resolution.get(signal, 0.0))
    bound = max(bound, 0.02 * float(np.ptp(values)))
    wild = np.flatnonzero(height > bound) + 1
    if not wild.size:
        return
    share = wild.size / len(values)
    rows = ", ".join(str(log.row_numbers[row]) for row in wild[:5])
    text = f"{signal} leaves both its neighbours by over {bound:.3g} {SIGNALS[signal]} in {wild.size} rows ({rows})"
    remedy = "nothing up to 1 % of the rows, which a robust fit bears; else find out where they come from"
    severity = "info" if share <= 0.01 else "warning"
    yield Finding(severity, "outliers", int(log.row_numbers[wild[0]]), text, remedy)


def _wrapped(log: Log) -> Iterator[Finding]:
    """A position that jumps by a turn."""
    steps = np.diff(log.signals["position"]) if log.has("position") else np.zeros(0)
    jumps = np.flatnonzero(np.abs(np.abs(steps) - 2.0 * np.pi) < 0.1 * 2.0 * np.pi)
    if not jumps.size or np.mean(np.abs(steps) > np.pi / 2.0) > 0.2:
        return
    text = f"the position jumps by a turn, {jumps.size} times, first here"
    remedy = "write position=unwrap(column, 2*pi):rad, or unwrap(column, 360):deg"
    yield Finding("error", "wrapped", int(log.row_numbers[jumps[0] + 1]), text, remedy)


def _implausible(log: Log, motor: Any) -> Iterator[Finding]:
    """Values that no bench has, more voltage than the supply has, and what looks like a duty."""
    for signal in _MOST.keys() & log.signals.keys():
        largest = float(np.quantile(np.abs(log.signals[signal]), 0.99))  # not an outlier
        if largest > _MOST[signal]:
            unit = SIGNALS[signal]
            text = f"the {signal} is up to {largest:.4g} {unit}, must be at most {_MOST[signal]:g} {unit} on a bench"
            yield Finding("error", "unit", None, text, f"correct its unit, such as {signal}=column:m{unit}")
    if not log.has("voltage"):
        return
    voltage = np.abs(log.signals["voltage"])
    if log.has("bus"):
        excess = voltage / np.maximum(np.abs(log.signals["bus"]), 1e-9)
        row = int(np.argmax(excess))
        if excess[row] >= 1.1:
            text = f"the voltage is up to {excess[row]:.3g} times that of the supply"
            remedy = "correct the scale of the duty, or of the bus"
            yield Finding("error", "unit", int(log.row_numbers[row]), text, remedy)
    elif motor is None and 0.0 < voltage.max() <= 1.0:
        text = f"the voltage is at most {voltage.max():.3g} V: is it a duty?"
        remedy = "if so, multiply it by that of the supply: voltage=column*24:V"
        yield Finding("warning", "unit", None, text, remedy)
