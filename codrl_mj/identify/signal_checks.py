"""What is wrong with one signal of a log by itself: its resolution, repeated rows, clipping, outliers."""

from collections.abc import Iterator

import numpy as np

from codrl_mj.identify.log import SIGNALS, Finding, Log

_MEASURED = "position", "velocity", "current", "torque"


def signal_findings(log: Log) -> Iterator[Finding]:
    """Look at each signal; only measured signals are clipped or spoiled, others rest where they like."""
    for signal in log.signals:
        yield from _resolution(log, signal)
        if signal in _MEASURED:
            yield from _repeated(log, signal)
        if signal in ("current", "torque", "velocity"):
            yield from _saturation(log, signal)
            yield from _outliers(log, signal)


def _resolution(log: Log, signal: str) -> Iterator[Finding]:
    """A quantisation that is coarse beside what the signal does."""
    step, values, unit = log.resolution.get(signal, 0.0), log.signals[signal], SIGNALS[signal] or ""
    if step == 0.0 or signal in ("command", "temperature", "duty", "voltage", "bus"):
        return
    spread = float(np.ptp(values))
    if spread < 100.0 * step if signal == "position" else step > 0.1 * float(np.std(values)):
        text = (
            f"{signal} is known to {step:.3g} {unit} and spans {spread:.3g} {unit},"
            f" {spread / step:.0f} steps"
        )
        remedies = {
            "position": "move further, or use a finer encoder",
            "velocity": (
                "leave it out and give the position, or smooth it over several ms and give that"
            ),
        }
        remedy = remedies.get(signal, "measure in a smaller range, or drive harder")
        yield Finding("warning", "resolution", None, text, remedy)


def _repeated(log: Log, signal: str) -> Iterator[Finding]:
    """Find a signal that is read less often than rows are written, so that rows repeat what was read before."""
    steps = np.diff(log.signals[signal])
    changes = np.flatnonzero(steps)
    if len(changes) < 20:
        return
    # A coarse sensor repeats its value too, but then moves on by a step or two of its resolution.
    every, size = float(np.median(np.diff(changes))), float(np.median(np.abs(steps[changes])))
    if every >= 2.0 and size > 2.5 * log.resolution.get(signal, 0.0):
        unit = SIGNALS[signal]
        text = (
            f"{signal} changes in every {every:.0f}th row only, by {size:.3g} {unit}: rows repeat"
            " old values"
        )
        remedy = "log a row when a value is read, or leave out the rows that repeat it"
        yield Finding("warning", "repeated", int(log.row_numbers[changes[0] + 1]), text, remedy)


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
            text = (
                f"{int(at.sum())} rows are at the {name} {signal}, {bound:.4g} {SIGNALS[signal]},"
                " the first one here"
            )
            remedy = (
                "if the sensor is clipped there, measure in a larger range, or leave these rows out"
                " with only="
            )
            yield Finding("warning", "saturation", row, text, remedy)


def _outliers(log: Log, signal: str) -> Iterator[Finding]:
    """Single rows that leave both neighbours by much more than others do."""
    values = log.signals[signal]
    if len(values) < 50:
        return
    before, after = np.diff(values)[:-1], np.diff(values)[1:]
    height = np.where(before * after < 0.0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    if log.has("voltage"):  # where that jumps, the current may have a peak
        jumps = np.abs(np.diff(log.signals["voltage"])) > 0.05 * float(
            np.ptp(log.signals["voltage"])
        )
        near = np.convolve(jumps, np.ones(5), mode="same") > 0.0
        height[near[:-1] | near[1:]] = 0.0
    peaks = height[height > 0.0]
    if peaks.size < 10:
        return
    bound = max(5.0 * float(np.quantile(peaks, 0.8)), 4.0 * log.resolution.get(signal, 0.0))
    bound = max(bound, 0.02 * float(np.ptp(values)))
    wild = np.flatnonzero(height > bound) + 1
    if wild.size:
        rows = ", ".join(str(log.row_numbers[row]) for row in wild[:5])
        text = (
            f"{signal} leaves both its neighbours by over {bound:.3g} {SIGNALS[signal]} in"
            f" {wild.size} rows ({rows})"
        )
        remedy = (
            "nothing up to 1 % of the rows, which a robust fit bears; else find out where they come"
            " from"
        )
        severity = "info" if wild.size / len(values) <= 0.01 else "warning"
        yield Finding(severity, "outliers", int(log.row_numbers[wild[0]]), text, remedy)
