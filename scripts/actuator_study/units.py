"""Doses in the units of a task: milliseconds, newton metres, percent; and what they are of."""

from collections.abc import Mapping

from codrl_mj.tasks import find_task

THINGS: Mapping[str, str] = {
    "lag": "lag",
    "weakness": "missing force",
    "supply": "missing voltage",
    "delay": "delay",
    "friction": "friction",
    "noise": "noise",
}
"""What the doses of each axis are of, in the order of `AXES`."""


def unit(task: str) -> str:
    """Of a task's force."""
    return "N" if task in ("cartpole", "mountain_car", "mountain_car_continuous") else "N·m"


def scale(task: str, axis: str) -> tuple[float, str]:
    """What a dose is to be multiplied by, and its unit then."""
    if axis in ("lag", "delay"):
        return 1000.0 * find_task(task).step_duration, "ms"
    return (
        (100.0, "%") if axis in ("weakness", "supply") else (find_task(task).max_force, unit(task))
    )


def short(value: float) -> str:
    """A number to two digits."""
    return f"{float(f'{value:.2g}'):g}"


def dose_text(task: str, axis: str, dose: float) -> str:
    """A dose in the units of a task."""
    factor, of = scale(task, axis)
    return f"{short(factor * dose)} {of}"


def size(task: str) -> str:
    """What doses of a task are shares of: its policy's step and its largest force."""
    return (
        f"{1000 * find_task(task).step_duration:g} ms, {find_task(task).max_force:g} {unit(task)}"
    )
