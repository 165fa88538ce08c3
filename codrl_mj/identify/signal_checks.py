"""Checks of single signals of a log: resolution, repeated rows, clipping and outliers."""

from collections.abc import Iterator

import numpy as np

from codrl_mj.identify.log import SIGNALS, Finding, Log

_MEASURED = "position", "velocity", "current", "torque"


def signal_findings(log: Log) -> Iterator[Finding]:
    """Yield findings about each signal by itself."""
    for signal in log.signals:
        yield from _resolution(log, signal)
        # Commanded signals, such as the voltage, may legitimately rest at a limit or change seldom.
        if signal in _MEASURED:
            yield from _repeated(log, signal)
        if signal in ("current", "torque", "velocity"):
            yield from _saturation(log, signal)
            yield from _outliers(log, signal)


def _resolution(log: Log, signal: str) -> Iterator[Finding]:
    """Find a quantization that is coarse compared with the signal's range."""
    step, values, unit = log.resolution.get(signal, 0.0), log.signals[signal], SIGNALS[signal] or ""
    if step == 0.0 or signal in ("command", "temperature", "duty", "voltage", "bus"):
        return
    spread = float(np.ptp(values))
    if spread < 100.0 * step if signal == "position" else step > 0.1 * float(np.std(values)):
        text = (
            f"{signal} has a resolution of {step:.3g} {unit} and spans {spread:.3g} {unit}, which"
            f" is {spread / step:.0f} steps"
        )
        remedies = {
            "position": "move further, or use a finer encoder",
            "velocity": "leave it out and use the position, or smooth it over several milliseconds",
        }
        remedy = remedies.get(signal, "measure in a smaller range, or use a larger amplitude")
        yield Finding("warning", "resolution", None, text, remedy)


def _repeated(log: Log, signal: str) -> Iterator[Finding]:
    """Find a signal that is sampled less often than rows are written, so that rows repeat it."""
    steps = np.diff(log.signals[signal])
    changes = np.flatnonzero(steps)
    if len(changes) < 20:
        return
    # A coarse sensor repeats its value too, but then moves on by a step or two of its resolution.
    period, change = float(np.median(np.diff(changes))), float(np.median(np.abs(steps[changes])))
    if period >= 2.0 and change > 2.5 * log.resolution.get(signal, 0.0):
        unit = SIGNALS[signal]
        text = (
            f"{signal} changes only in every {period:.0f}th row, by {change:.3g} {unit}: rows"
            " repeat old values"
        )
        remedy = "log a row when a value is read, or leave out the rows that repeat it"
        yield Finding("warning", "repeated", int(log.row_numbers[changes[0] + 1]), text, remedy)


def _saturation(log: Log, signal: str) -> Iterator[Finding]:
    """Find a signal that often rests at its highest or lowest value, as if it were clipped."""
    values = log.signals[signal]
    spread = float(np.ptp(values))
    for name, bound in (("highest", float(values.max())), ("lowest", float(values.min()))):
        distances = np.abs(values - bound)
        margin = max(0.05 * spread, 3.5 * log.resolution.get(signal, 0.0))
        clipped = distances <= 1e-6 * spread
        nearby = (distances > 1e-6 * spread) & (distances <= margin)
        # A clipped signal has a flat top; a signal that rests near 0 is not clipped there.
        if clipped.sum() >= 10 and clipped.sum() > 3 * nearby.sum() and abs(bound) > 0.2 * spread:
            row = int(log.row_numbers[np.flatnonzero(clipped)[0]])
            text = (
                f"{int(clipped.sum())} rows are at the {name} {signal}, {bound:.4g}"
                f" {SIGNALS[signal]}, the first one here"
            )
            remedy = (
                "if the sensor is clipped there, measure in a larger range, or leave these rows out"
                " with only="
            )
            yield Finding("warning", "saturation", row, text, remedy)


def _outliers(log: Log, signal: str) -> Iterator[Finding]:
    """Find single rows that differ from both neighbors much more than usual."""
    values = log.signals[signal]
    if len(values) < 50:
        return
    before, after = np.diff(values)[:-1], np.diff(values)[1:]
    height = np.where(before * after < 0.0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    # The current may have a peak where the voltage jumps.
    if log.has("voltage"):
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
    outliers = np.flatnonzero(height > bound) + 1
    if outliers.size:
        rows = ", ".join(str(log.row_numbers[row]) for row in outliers[:5])
        text = (
            f"{signal} differs from both neighboring rows by over {bound:.3g} {SIGNALS[signal]} in"
            f" {outliers.size} rows ({rows})"
        )
        remedy = (
            "the robust fit tolerates outliers in up to 1 % of the rows; if there are more, find"
            " their cause"
        )
        severity = "info" if outliers.size / len(values) <= 0.01 else "warning"
        yield Finding(severity, "outliers", int(log.row_numbers[outliers[0]]), text, remedy)
