"""Named actuators: the one definition of every actuator that has a name.

Each is a variation of the task's own motor, so that a name means the same kind of actuator on every task.
"""

import dataclasses
import difflib
from collections.abc import Callable, Mapping
from typing import Any

from codrl_mj.motor.parameters import Actuator, CurrentLoop, Motor

PAPER: dict[str, Actuator] = {
    # The paper, Experimental Results: gains and arm of each task. R, L, kT, kE are the dataclass defaults.
    "pendulum": Actuator(Motor(), CurrentLoop(kp=1.0, ki=20.0, kd=1e-6)),
    "mountain_car": Actuator(Motor(), CurrentLoop(kp=1.0, ki=1.0, kd=1e-2)),
    "mountain_car_continuous": Actuator(Motor(), CurrentLoop(kp=0.1, ki=10.0, kd=1e-3)),
    "acrobot": Actuator(Motor(), CurrentLoop(kp=1.0, ki=10.0, kd=1e-6)),
    "cartpole": Actuator(Motor(arm_radius=0.15), CurrentLoop(kp=4.3, ki=1.0, kd=1e-6, kff=0.6)),
}
"""The paper's motor and gains, by task."""


def _with_loop(paper: Actuator, **gains: float) -> Actuator:
    return dataclasses.replace(paper, controller=CurrentLoop(**gains))  # type: ignore[arg-type]


def _open_loop(paper: Actuator) -> Actuator:
    slow = dataclasses.replace(paper.motor, inductance=0.5)
    return Actuator(slow, CurrentLoop(kp=0.0, kff=slow.resistance))


NAMED: dict[str, tuple[str, Callable[[Actuator], Actuator | None]]] = {
    "ideal": ("force = desired force: no motor at all", lambda _: None),
    "paper": ("the paper's motor and gains for the task", lambda paper: paper),
    "weak": (
        "the paper's motor under a weak loop: kp = ki = 1",
        lambda paper: _with_loop(paper, kp=1.0, ki=1.0),
    ),
    "weaker": ("a weaker loop: kp = ki = 0.2", lambda paper: _with_loop(paper, kp=0.2, ki=0.2)),
    "open_loop": ("no feedback, u = R*i_ref + kE*omega, and a slow winding: L = 0.5 H", _open_loop),
}
"""Name -> (what it is, function from the task's paper actuator to the actuator; None is the ideal one)."""


def named_actuator(name: str, task: str) -> Actuator | None:
    """The actuator called `name` on `task`; None is the ideal actuator.

    Args:
        name: one of `NAMED`.
        task: a task name, as on the command line.

    Raises:
        ValueError: unknown name; the nearest known one is suggested.
    """
    if name not in NAMED:
        near = difflib.get_close_matches(name, NAMED, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ValueError(f"unknown actuator {name!r}: {hint}Known actuators: {', '.join(NAMED)}")
    return NAMED[name][1](PAPER[task])


def resolve(actuator: "str | Actuator | Mapping[str, Any] | None", task: str) -> Actuator | None:
    """Turn whatever a user may write for an actuator into an `Actuator`, or None for the ideal one.

    Args:
        actuator: a name of `NAMED`, an `Actuator`, a mapping of its fields, or None (ideal).
        task: the task whose paper actuator the names vary.

    Raises:
        ValueError: unknown name or field, or a value out of bounds.
    """
    if actuator is None or isinstance(actuator, Actuator):
        return actuator
    if isinstance(actuator, str):
        return named_actuator(actuator, task)
    if isinstance(actuator, Mapping):
        return Actuator.from_mapping(actuator)
    raise ValueError(
        f"actuator = {actuator!r}: must be a name ({', '.join(NAMED)}), an Actuator or a mapping of its fields"
    )


def actuator_over(base: Actuator | None, fields: Mapping[str, Mapping[str, Any]]) -> Actuator | None:
    """An actuator with single fields set over another's.

    Args:
        base: the other one; None is the ideal actuator.
        fields: for example `{"controller": {"kp": 2.0}}`.

    Raises:
        ValueError: a field is unknown or out of bounds, or set over the ideal actuator, which has none.
    """
    if not any(fields.values()):
        return base
    if base is None:
        raise ValueError(
            "the ideal actuator has no motor and no controller to set fields of: name another actuator, such as paper"
        )
    mapping: dict[str, Any] = base.as_mapping()
    for part, changes in fields.items():
        mapping[part] = mapping.get(part, {}) | dict(changes)
    return Actuator.from_mapping(mapping)
