"""The choice of a motor and of its gear: the smallest that does it with a margin."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import Drive, named_mapping, set_display_name
from codrl_mj.catalogue import MotorEntry, motor_names
from codrl_mj.sizing.abilities import find_drive, find_entry, max_power
from codrl_mj.sizing.demand import Demand
from codrl_mj.sizing.feasibility import (
    MAX_FRICTION_SHARE,
    MAX_ROTOR_SHARE,
    SURELY,
    VERDICTS,
    Feasibility,
    best_ratio,
    feasibility,
    friction_share,
    margin,
    operation,
)

MARGIN = 0.2
"""Share of voltage and currents that a motor is to leave: a rule of thumb, for the tolerances of motor and supply."""
_SPREAD = math.log(16.0)
"""Gears are tried up to this far, in logarithms, from that of the largest torque and the largest speed."""
_WANTED = ("coulomb_friction", "viscous_friction", "gear_efficiency", "continuous_current")
"""What a datasheet may leave open, and is not counted then, besides what `Drive.assumed` says."""


class Candidate(NamedTuple):
    """A motor with a gear, judged."""

    name: str
    """Of the motor."""
    drive: Drive
    """The motor with gear and supply."""
    unknown: tuple[str, ...]
    """Numbers that its datasheet leaves open, and that are not counted."""
    feasibility: Feasibility
    """The judgment."""
    rejection_reason: str
    """The reason why it is not to be taken; empty where it is."""

    def for_model_gear(self, gear: float) -> Drive:
        """The drive for an actuator of a model with a gear of its own, which the arm undoes: `Demand.model_gear`."""
        return self.drive.replaced({"motor.arm_radius": gear * self.drive.motor.arm_radius})

    @property
    def power(self) -> float:
        """The most mechanical power [W] that the motor makes at its supply: its size, whatever its winding and gear."""
        return max_power(self.drive)

    @property
    def ratio(self) -> float:
        """Turns of the rotor for one of the joint; on a slide rad/m."""
        return 1.0 / self.drive.arm_radius


def actuators_of(choices: Mapping[str, tuple[Candidate, Demand]]) -> dict[str, Any]:
    """What `codrl_mj.make` and `--actuators` take: pattern -> fields of the actuator.

    Args:
        choices: name of a motor of the model -> what was chosen for it, and for what; of a single
            one the name may be empty.
    """
    found = {}
    for name, (choice, demand) in choices.items():
        drive = set_display_name(choice.for_model_gear(demand.model_gear), Path(choice.name).stem)
        found[" & ".join(map(re.escape, name.split(" & "))) if name else ".*"] = named_mapping(
            drive
        )
    return found


def ignored_quantities(entry: MotorEntry | None) -> tuple[str, ...]:
    """What a motor's datasheet leaves open, and is not counted; of a drive without one that is all of its heat."""
    if entry is None:
        return ("continuous current",)
    return tuple(name.replace("_", " ") for name in _WANTED if getattr(entry.numbers, name) is None)


def choose(
    demand: Demand,
    motors: Sequence[str] | None = None,
    voltage: float | None = None,
    min_margin: float = MARGIN,
    gears: Sequence[float] | None = None,
    max_current: float | None = None,
) -> list[Candidate]:
    """Rank motors with their gears: those that do it, from the smallest; then the others by verdict and shortage.

    A motor does it if `feasibility` says `surely`, with a margin. More than enough of a motor is no
    merit: it is dear and heavy, and moves itself. A motor with a gear of its own keeps it, and on a
    slide gets a wheel; the others get the gear of `with_best_gear`.

    Args:
        demand: what is asked.
        motors: names; None: the whole catalogue.
        voltage: of the supply [V]; None: each motor's own.
        least_margin: share of voltage, largest and continuous current that has to be left, in [0,
            1).
        gears: ratios that can be had, turns of the rotor for one of the joint, on a slide rad/m;
            every motor is judged with each of them.
        max_current: that the drive gives [A]; None: each motor's own.

    Raises:
        ValueError: there is no such motor, or the margin or a gear is out of bounds.
    """
    if not 0.0 <= min_margin < 1.0:
        raise ValueError(
            f"least_margin = {min_margin:g}: must be >= 0 and < 1, the share that is to be left,"
            f" such as {MARGIN:g}"
        )
    choices = []
    for name in motor_names() if motors is None else motors:
        entry = find_entry(name)
        continuous = entry.numbers.continuous_current if entry else None
        for gear in gears or (None,):
            drive = find_drive(name, gear, voltage=voltage, max_current=max_current)
            fixed = gear is not None or (drive.motor.gear_ratio != 1.0 and not demand.linear)
            drive = drive if fixed else with_best_gear(drive, demand, continuous)
            found = feasibility(drive, demand, continuous)
            choices.append(
                Candidate(name, drive, ignored_quantities(entry), found, _rejection_reason(found, min_margin))
            )

    def rank(choice: Candidate) -> tuple[bool, int, float, float]:
        found = choice.feasibility
        size = 0.0 if choice.rejection_reason else choice.power
        return choice.rejection_reason != "", VERDICTS.index(found.verdict), size, found.shortage

    return sorted(choices, key=rank)


def _rejection_reason(found: Feasibility, least: float) -> str:
    """Return the reason why a motor is not to be taken; empty where it is."""
    if found.verdict != SURELY:
        return f"{found.verdict}. {found.reason}"
    return (
        ""
        if found.margin >= least
        else f"surely, but with a margin of {found.margin:.0%}, must be {least:.0%}"
    )


def with_best_gear(drive: Drive, demand: Demand, continuous: float | None = None) -> Drive:
    """Return the drive with its best gear, or on a slide wheel: that of the largest margin, rotor and friction counted.

    A gear has a ratio >= 1. Friction may take `MAX_FRICTION_SHARE` of the load where that leaves a
    margin. Each of the margin's parts is, but for friction, the largest of functions a/N + b*N, so
    it has one maximum over N.

    Args:
        drive: the motor, with any gear.
        demand: what is asked.
        continuous: current that the winding bears for good [A]; None: unknown.
    """
    from scipy.optimize import minimize_scalar

    low, high = _logarithms(drive, demand)
    if low == high:
        return drive

    def load(logarithm: float) -> float:
        with_gear = _with_ratio(drive, demand, logarithm)
        asked = operation(demand, with_gear)
        share = 0.0 if demand.exact else asked.own_share / MAX_ROTOR_SHARE
        return max(1.0 - margin(with_gear, asked, continuous), share)

    def best(highest: float) -> Drive:
        within = low, max(min(highest, high), low + 1e-9)
        at = minimize_scalar(load, bounds=within, method="bounded", options={"xatol": 0.01}).x
        return _with_ratio(drive, demand, float(at))

    rubbed = (
        0.0 if demand.exact else friction_share(_with_ratio(drive, demand, 0.0), demand)
    )  # it grows with the ratio
    if rubbed > 0.0 and MAX_FRICTION_SHARE / rubbed > math.exp(low):
        smooth = best(math.log(MAX_FRICTION_SHARE / rubbed))
        if margin(smooth, operation(demand, smooth), continuous) >= 0.0:
            return smooth
    return best(math.inf)


def equivalent_gears(
    best: Drive, demand: Demand, continuous: float | None = None
) -> tuple[float, float]:
    """Return the lowest and the highest ratio around the best one that have its verdict."""
    verdict, middle = feasibility(best, demand, continuous).verdict, -math.log(best.arm_radius)

    def edge(beyond: float) -> float:
        within = middle
        for _ in range(12):
            tried = (within + beyond) / 2.0
            same = (
                feasibility(_with_ratio(best, demand, tried), demand, continuous).verdict == verdict
            )
            within, beyond = (tried, beyond) if same else (within, tried)
        return math.exp(within)

    low, high = _logarithms(best, demand)
    return edge(low), edge(high)


def _logarithms(drive: Drive, demand: Demand) -> tuple[float, float]:
    """Return the logarithms of the lowest and the highest ratio to try: the drive's own where all are alike.

    A gear does not speed a motor up.
    """
    torque, speed = np.abs(demand.torque).max(), np.abs(demand.speed).max()
    if not torque * speed * drive.motor.back_emf_constant > 0.0:
        return -math.log(drive.arm_radius), -math.log(drive.arm_radius)
    middle = math.log(best_ratio(torque, speed, drive.motor))
    low = middle - _SPREAD if demand.linear else max(middle - _SPREAD, 0.0)
    return low, max(middle + _SPREAD, low + 1e-9)


def _with_ratio(drive: Drive, demand: Demand, logarithm: float) -> Drive:
    """Return the drive with a ratio of exp(logarithm), by its gear, or on a slide by its wheel."""
    ratio = math.exp(logarithm)
    if demand.linear:
        return drive.replaced({"motor.arm_radius": drive.motor.gear_ratio / ratio})
    return drive.replaced({"motor.gear_ratio": ratio})
