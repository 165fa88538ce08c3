"""Severities in the units of a task, such as milliseconds and newton meters."""

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
"""Axis -> name of its quantity on the page, in the order of `AXES`."""


def unit(task: str) -> str:
    """Return the unit of a task's force."""
    return "N" if task in ("cartpole", "mountain_car", "mountain_car_continuous") else "N·m"


def scale(task: str, axis: str) -> tuple[float, str]:
    """Return the factor from a severity to a physical quantity, and its unit."""
    if axis in ("lag", "delay"):
        return 1000.0 * find_task(task).step_duration, "ms"
    return (
        (100.0, "%") if axis in ("weakness", "supply") else (find_task(task).max_force, unit(task))
    )


def short(value: float) -> str:
    """Format a number with two significant digits."""
    return f"{float(f'{value:.2g}'):g}"


def severity_text(task: str, axis: str, severity: float) -> str:
    """Format a severity in the units of a task."""
    factor, unit_text = scale(task, axis)
    return f"{short(factor * severity)} {unit_text}"


def size(task: str) -> str:
    """Format the scales of a task's severities: the policy's step and the largest force."""
    return (
        f"{1000 * find_task(task).step_duration:g} ms, {find_task(task).max_force:g} {unit(task)}"
    )
