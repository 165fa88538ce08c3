"""Which motor of the catalogue, with which gear."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import Drive
from codrl_mj.catalogue import motor_names
from codrl_mj.motor_design.drives import find_drive, find_entry
from codrl_mj.sizing.bounds import VERDICTS, Feasibility, feasibility, margin
from codrl_mj.sizing.demand import Demand
from codrl_mj.sizing.operation import best_ratio, operation

_SPREAD = math.log(16.0)
"""Gears are tried up to this far, in logarithms, from that of the largest torque and the largest speed."""
_WANTED = {
    "rotor_inertia": "rotor inertia",
    "coulomb_friction": "Coulomb friction",
    "viscous_friction": "viscous friction",
    "gear_efficiency": "gear efficiency",
    "max_current": "largest current",
    "continuous_current": "continuous current",
    "voltage": "nominal voltage",
}
"""What a datasheet may leave open: losses and inertia are 0 then, currents have no limit, the supply has 24 V."""


class Catalogued(NamedTuple):
    """A motor with gear and supply."""

    drive: Drive
    """What drives the joint."""
    continuous_current: float | None
    """That the winding bears for good [A]; None if it is unknown."""
    unknown: tuple[str, ...]
    """What its datasheet leaves open, and is not counted."""


class Choice(NamedTuple):
    """A motor of the catalogue at its best gear."""

    name: str
    """The motor's."""
    drive: Drive
    """With gear and supply."""
    unknown: tuple[str, ...]
    """What its datasheet leaves open, and is not counted."""
    feasibility: Feasibility
    """What it can do."""

    @property
    def ratio(self) -> float:
        """Turns of the rotor for one of the joint; on a slide rad/m."""
        return 1.0 / self.drive.arm_radius


def catalogued(name: str, gear_ratio: float | None = None, voltage: float | None = None) -> Catalogued:
    """A motor by name.

    Args:
        name: as `codrl_mj.motor_design.find_drive` takes it; no more is known of a drive that is no datasheet's.
        gear_ratio: turns of the rotor for one of the output; None: its own, or 1.
        voltage: of the supply [V]; None: its nominal one, or 24.

    Raises:
        ValueError: there is no such motor, or a number is out of bounds.
    """
    drive, entry = find_drive(name, gear_ratio, voltage=voltage), find_entry(name)
    if entry is None:
        return Catalogued(drive, None, ("continuous current",))
    unknown = [label for number, label in _WANTED.items() if getattr(entry.numbers, number) is None]
    given = "" if voltage is None else "nominal voltage"
    return Catalogued(drive, entry.numbers.continuous_current, tuple(one for one in unknown if one != given))


def choose(demand: Demand, motors: Sequence[str] | None = None, voltage: float | None = None) -> list[Choice]:
    """Motors at their best gears, by verdict and then by margin.

    A motor with a gear of its own keeps it, and on a slide gets a wheel; the others get the gear of the largest margin.

    Args:
        demand: what is asked.
        motors: names; None: the whole catalogue.
        voltage: of the supply [V]; None: each motor's own.

    Raises:
        ValueError: there is no such motor.
    """
    choices = []
    for name in motor_names() if motors is None else motors:
        drive, continuous, unknown = catalogued(name, None, voltage)
        best = _geared(drive, demand, continuous)
        choices.append(Choice(name, best, unknown, feasibility(best, demand, continuous)))
    return sorted(choices, key=lambda c: (VERDICTS.index(c.feasibility.verdict), -c.feasibility.margin))


def _geared(drive: Drive, demand: Demand, continuous: float | None) -> Drive:
    """The drive with the gear, or the wheel, whose margin is largest.

    Each of the margin's parts is, but for friction, the largest of functions a/N + b*N, so it has one maximum over N.
    """
    from scipy.optimize import minimize_scalar

    motor, own = drive.motor, drive.motor.gear_ratio
    torque, speed = np.abs(demand.torque).max(), np.abs(demand.speed).max()
    if (own != 1.0 and not demand.linear) or not torque * speed * motor.back_emf_constant > 0.0:
        return drive
    middle = math.log(best_ratio(torque, speed, motor))

    def geared(logarithm: float) -> Drive:
        ratio = math.exp(logarithm)
        change = {"arm_radius": own / ratio} if demand.linear else {"gear_ratio": ratio}
        return dataclasses.replace(drive, motor=dataclasses.replace(motor, **change))

    def load(logarithm: float) -> float:
        return -margin(geared(logarithm), operation(demand, geared(logarithm)), continuous)

    bounds = middle - _SPREAD, middle + _SPREAD
    found = minimize_scalar(load, bounds=bounds, method="bounded", options={"xatol": 0.01})
    return geared(float(found.x))
