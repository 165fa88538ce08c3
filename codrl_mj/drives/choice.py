"""Which motor of the catalogue, with which gear: the smallest that does it with a margin."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import Drive, labelled, named_mapping
from codrl_mj.catalogue import MotorEntry, motor_names
from codrl_mj.drives.abilities import find_drive, find_entry, most_power
from codrl_mj.drives.demand import Demand
from codrl_mj.drives.feasibility import SURELY, VERDICTS, Feasibility, best_ratio, feasibility, margin, operation

MARGIN = 0.2
"""Share of voltage and currents that a motor is to leave: a rule of thumb, for the tolerances of motor and supply."""
MOST_SHARE = 0.5
"""Largest share that rotor and friction may take of the largest load: in a task a policy can ask for no more."""
MOST_FRICTION = 0.05
"""Largest share that Coulomb friction at the joint may take of it. Policies that never met as much lost at most 0.05 of
the score on five tasks and 0.10 on Mountain Car, and with twice as much up to 0.18 (docs/results/actuators.md)."""
_SPREAD = math.log(16.0)
"""Gears are tried up to this far, in logarithms, from that of the largest torque and the largest speed."""
_WANTED = ("coulomb_friction", "viscous_friction", "gear_efficiency", "continuous_current")
"""What a datasheet may leave open, and is not counted then, besides what `Drive.assumed` says."""


class Candidate(NamedTuple):
    """A motor of the catalogue at its best gear."""

    name: str
    """The motor's."""
    drive: Drive
    """With gear and supply."""
    unknown: tuple[str, ...]
    """What its datasheet leaves open, and is not counted."""
    feasibility: Feasibility
    """What it can do."""
    lacks: str
    """Why it is not to be taken; empty where it is."""

    def behind(self, gear: float) -> Drive:
        """The drive for an actuator of a model with a gear of its own, which the arm undoes: `Demand.model_gear`."""
        return self.drive.replaced({"motor.arm_radius": gear * self.drive.motor.arm_radius})

    @property
    def power(self) -> float:
        """The most mechanical power [W] that the motor makes at its supply: its size, whatever its winding and gear."""
        return most_power(self.drive)

    @property
    def ratio(self) -> float:
        """Turns of the rotor for one of the joint; on a slide rad/m."""
        return 1.0 / self.drive.arm_radius


def actuators_of(choices: Mapping[str, tuple[Candidate, Demand]]) -> dict[str, Any]:
    """What `codrl_mj.make` and `--actuators` take: pattern -> fields of the actuator.

    Args:
        choices: name of a motor of the model -> what was chosen for it, and for what; of a single one the name may be
            empty.
    """
    found = {}
    for name, (choice, demand) in choices.items():
        drive = labelled(choice.behind(demand.model_gear), Path(choice.name).stem)
        found[" & ".join(map(re.escape, name.split(" & "))) if name else ".*"] = named_mapping(drive)
    return found


def uncounted(entry: MotorEntry | None) -> tuple[str, ...]:
    """What a motor's datasheet leaves open, and is not counted; of a drive without one that is all of its heat."""
    if entry is None:
        return ("continuous current",)
    return tuple(name.replace("_", " ") for name in _WANTED if getattr(entry.numbers, name) is None)


def choose(
    demand: Demand, motors: Sequence[str] | None = None, voltage: float | None = None, least_margin: float = MARGIN
) -> list[Candidate]:
    """Motors at their best gears: those that do it, from the smallest; then the others by verdict and margin.

    A motor does it if voltage, largest current and heat hold with a margin, its heat is known, and it leaves to the
    load what a policy can ask for; a recording asks for whatever it takes. More than enough of a motor is no merit:
    it is dear and heavy, and moves itself. A motor with a gear of its own keeps it, and on a slide gets a wheel; the
    others get the gear at which the tightest of these is widest.

    Args:
        demand: what is asked.
        motors: names; None: the whole catalogue.
        voltage: of the supply [V]; None: each motor's own.
        least_margin: share of voltage, largest and continuous current that has to be left, in [0, 1).

    Raises:
        ValueError: there is no such motor, or the margin is out of bounds.
    """
    if not 0.0 <= least_margin < 1.0:
        raise ValueError(
            f"least_margin = {least_margin:g}: must be >= 0 and < 1, the share that is to be left, such as {MARGIN:g}"
        )
    choices = []
    for name in motor_names() if motors is None else motors:
        drive, entry = find_drive(name, voltage=voltage), find_entry(name)
        continuous = entry.numbers.continuous_current if entry else None
        fixed = drive.motor.gear_ratio != 1.0 and not demand.linear
        best = drive if fixed else geared(drive, demand, continuous)
        found = feasibility(best, demand, continuous)
        choices.append(
            Candidate(name, best, uncounted(entry), found, _lacks(best, found, demand, continuous, least_margin))
        )

    def rank(choice: Candidate) -> tuple[bool, int, float]:
        found = choice.feasibility
        return choice.lacks != "", VERDICTS.index(found.verdict), -found.margin if choice.lacks else choice.power

    return sorted(choices, key=rank)


def _lacks(drive: Drive, found: Feasibility, demand: Demand, continuous: float | None, least: float) -> str:
    """Why a motor is not to be taken."""
    if found.verdict != SURELY:
        return f"{found.verdict}. {found.why}"
    if found.margin < least:
        return f"surely, but with a margin of {found.margin:.0%}, must be {least:.0%}"
    if not demand.exact and found.operation.own_share > MOST_SHARE:
        share = f"{found.operation.own_share:.0%} of the largest load, must be <= {MOST_SHARE:.0%}"
        return f"surely, but its rotor and friction take {share}: a policy cannot ask for so much more"
    if not demand.exact and (friction := _friction(drive, demand)) > MOST_FRICTION:
        share = f"{friction:.0%} of the largest load, must be <= {MOST_FRICTION:.0%}"
        return f"surely, but its friction takes {share}: a policy that never met it would notice"
    if continuous is None:
        return "surely, but how long: its continuous current is not known"
    return ""


def _friction(drive: Drive, demand: Demand) -> float:
    return drive.additions.friction / float(np.abs(demand.torque).max())


def geared(drive: Drive, demand: Demand, continuous: float | None = None) -> Drive:
    """The drive with the gear, or on a slide the wheel, of the largest margin, what it takes itself considered.

    Friction may take `MOST_FRICTION` of the load where that leaves a `MARGIN`. Each of the margin's parts is, but for
    friction, the largest of functions a/N + b*N, so it has one maximum over N.

    Args:
        drive: the motor, with any gear.
        demand: what is asked.
        continuous: current that the winding bears for good [A]; None: unknown.
    """
    from scipy.optimize import minimize_scalar

    motor, own = drive.motor, drive.motor.gear_ratio
    torque, speed = np.abs(demand.torque).max(), np.abs(demand.speed).max()
    if not torque * speed * motor.back_emf_constant > 0.0:
        return drive
    middle = math.log(best_ratio(torque, speed, motor))

    def at(logarithm: float) -> Drive:
        ratio = math.exp(logarithm)
        return drive.replaced({"motor.arm_radius": own / ratio} if demand.linear else {"motor.gear_ratio": ratio})

    def load(logarithm: float) -> float:
        asked = operation(demand, at(logarithm))
        share = 0.0 if demand.exact else asked.own_share / MOST_SHARE
        return max(1.0 - margin(at(logarithm), asked, continuous), share)

    def best(high: float) -> Drive:
        bounds = middle - _SPREAD, max(min(high, middle + _SPREAD), middle - _SPREAD)
        return at(float(minimize_scalar(load, bounds=bounds, method="bounded", options={"xatol": 0.01}).x))

    rubbed = 0.0 if demand.exact else _friction(at(0.0), demand)  # of a ratio of 1; it grows with it
    if rubbed > 0.0:
        smooth = best(math.log(MOST_FRICTION / rubbed))
        if margin(smooth, operation(demand, smooth), continuous) >= MARGIN:
            return smooth
    return best(math.inf)
