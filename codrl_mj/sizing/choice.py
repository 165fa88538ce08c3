"""Choice of a motor and its gear: the smallest motor that meets a demand with a margin."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import ActuatorSetting, Drive, named_mapping, set_display_name
from codrl_mj.catalogue import MotorEntry, motor_names
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
    operating_points,
)
from codrl_mj.sizing.joint_demand import Demand
from codrl_mj.sizing.limits import find_drive, find_entry, max_power

MARGIN = 0.2
"""Required margin of voltage and currents: a rule of thumb for tolerances of motor and supply."""
_LOG_RATIO_RANGE = math.log(16.0)
"""Search range of log(gear ratio) on either side of the best ratio for the largest torque and
speed of the demand.
"""
_OPTIONAL_NUMBERS = (
    "coulomb_friction",
    "viscous_friction",
    "gear_efficiency",
    "continuous_current",
)
"""Quantities that are ignored if a datasheet omits them, besides those in `Drive.assumed`."""


class Candidate(NamedTuple):
    """Motor with a gear, and its feasibility."""

    name: str
    """Name of the motor."""
    drive: Drive
    """Motor with gear and supply."""
    unknown: tuple[str, ...]
    """Quantities that its datasheet omits, and that the judgment therefore ignores."""
    feasibility: Feasibility
    """Feasibility of the demand on the motor."""
    rejection_reason: str
    """Reason why it is rejected; empty if it is suitable."""

    def for_model_gear(self, gear: float) -> Drive:
        """Return the drive for an actuator whose model has a gear (`Demand.model_gear`)."""
        # The model multiplies the force by its gear; the larger arm radius compensates for that.
        return self.drive.replaced({"motor.arm_radius": gear * self.drive.motor.arm_radius})

    @property
    def power(self) -> float:
        """Largest mechanical power [W]: the motor's size, regardless of winding and gear."""
        return max_power(self.drive)

    @property
    def ratio(self) -> float:
        """Gear ratio: turns of the rotor for one turn of the joint; on a slide [rad/m]."""
        return 1.0 / self.drive.arm_radius


def actuators_of(
    choices: Mapping[str, tuple[Candidate, Demand]],
) -> dict[str, ActuatorSetting]:
    """Return pattern -> fields of the actuator, as `codrl_mj.make` and `--actuators` accept it.

    Args:
        choices: name of a motor in the model -> chosen candidate and its demand; the name may be
            empty if there is only one motor.
    """
    actuators: dict[str, ActuatorSetting] = {}
    for name, (choice, demand) in choices.items():
        drive = set_display_name(choice.for_model_gear(demand.model_gear), Path(choice.name).stem)
        actuators[" & ".join(map(re.escape, name.split(" & "))) if name else ".*"] = named_mapping(
            drive
        )
    return actuators


def ignored_quantities(entry: MotorEntry | None) -> tuple[str, ...]:
    """Return the quantities that a datasheet omits, and that a judgment therefore ignores.

    Without a datasheet only the continuous current counts as unknown.
    """
    if entry is None:
        return ("continuous current",)
    return tuple(
        name.replace("_", " ")
        for name in _OPTIONAL_NUMBERS
        if getattr(entry.parameters, name) is None
    )


def choose(
    demand: Demand,
    motors: Sequence[str] | None = None,
    voltage: float | None = None,
    min_margin: float = MARGIN,
    gears: Sequence[float] | None = None,
    max_current: float | None = None,
) -> list[Candidate]:
    """Rank motors with gears: suitable ones by size, then the others by verdict and shortage.

    A motor is suitable if `feasibility` returns `surely` with the required margin. A larger motor
    than needed is no advantage: it is expensive and heavy, and has to accelerate a larger rotor. At
    a rotary joint a motor with a gear keeps it; all other motors get the gear (on a slide, the
    wheel) of `with_best_gear`.

    Args:
        demand: demand of the joint.
        motors: names of motors; None takes the whole catalogue.
        voltage: voltage of the supply [V]; None takes each motor's nominal voltage.
        min_margin: required margin of voltage, largest and continuous current, in [0, 1).
        gears: gear ratios to try with every motor: turns of the rotor for one turn of the joint, or
            [rad/m] on a slide; None selects a gear as described above.
        max_current: largest current of the drive [A]; None keeps the limit of each motor.

    Raises:
        ValueError: a motor is unknown, or the margin or a gear is out of bounds.
    """
    if not 0.0 <= min_margin < 1.0:
        raise ValueError(
            f"min_margin = {min_margin:g}: must be >= 0 and < 1, the share of voltage and current"
            f" to keep in reserve, such as {MARGIN:g}"
        )
    choices = []
    for name in motor_names() if motors is None else motors:
        entry = find_entry(name)
        continuous = entry.parameters.continuous_current if entry else None
        for gear in gears or (None,):
            drive = find_drive(name, gear, voltage=voltage, max_current=max_current)
            fixed = gear is not None or (drive.motor.gear_ratio != 1.0 and not demand.linear)
            drive = drive if fixed else with_best_gear(drive, demand, continuous)
            judgment = feasibility(drive, demand, continuous)
            choices.append(
                Candidate(
                    name,
                    drive,
                    ignored_quantities(entry),
                    judgment,
                    _rejection_reason(judgment, min_margin),
                )
            )

    def rank(choice: Candidate) -> tuple[bool, int, float, float]:
        judgment = choice.feasibility
        size = 0.0 if choice.rejection_reason else choice.power
        return (
            choice.rejection_reason != "",
            VERDICTS.index(judgment.verdict),
            size,
            judgment.shortage,
        )

    return sorted(choices, key=rank)


def _rejection_reason(judgment: Feasibility, min_margin: float) -> str:
    """Return the reason why a motor is rejected; empty if it is suitable."""
    if judgment.verdict != SURELY:
        return f"{judgment.verdict}. {judgment.reason}"
    return (
        ""
        if judgment.margin >= min_margin
        else f"surely, but with a margin of {judgment.margin:.0%}, must be >= {min_margin:.0%}"
    )


def with_best_gear(drive: Drive, demand: Demand, continuous: float | None = None) -> Drive:
    """Return the drive with the gear (on a slide, the wheel) that gives the largest margin.

    The ratio is >= 1 at a rotary joint. Coulomb friction takes at most `MAX_FRICTION_SHARE` of the
    load, if a positive margin is possible with such a ratio.

    Args:
        drive: motor with any gear.
        demand: demand of the joint.
        continuous: continuous current of the winding [A]; None if unknown.
    """
    from scipy.optimize import minimize_scalar

    low, high = _log_ratio_bounds(drive, demand)
    if low == high:
        return drive

    # Except for friction, each term of the utilization is a maximum of functions a/N + b*N of the
    # ratio N. So the utilization has one minimum over N, which a bounded scalar search finds.
    def utilization(logarithm: float) -> float:
        with_gear = _with_ratio(drive, demand, logarithm)
        required = operating_points(demand, with_gear)
        rotor_share = 0.0 if demand.exact else required.own_share / MAX_ROTOR_SHARE
        return max(1.0 - margin(with_gear, required, continuous), rotor_share)

    def best_below(max_log_ratio: float) -> Drive:
        within = low, max(min(max_log_ratio, high), low + 1e-9)
        optimum = minimize_scalar(
            utilization, bounds=within, method="bounded", options={"xatol": 0.01}
        ).x
        return _with_ratio(drive, demand, float(optimum))

    # Friction at the joint grows with the ratio, so its limit is an upper bound on the ratio.
    friction = 0.0 if demand.exact else friction_share(_with_ratio(drive, demand, 0.0), demand)
    if friction > 0.0 and MAX_FRICTION_SHARE / friction > math.exp(low):
        limited = best_below(math.log(MAX_FRICTION_SHARE / friction))
        if margin(limited, operating_points(demand, limited), continuous) >= 0.0:
            return limited
    return best_below(math.inf)


def equivalent_gears(
    best: Drive, demand: Demand, continuous: float | None = None
) -> tuple[float, float]:
    """Return the lowest and highest gear ratio with the same verdict as the drive `best`."""
    verdict, middle = feasibility(best, demand, continuous).verdict, -math.log(best.arm_radius)

    def edge(outside: float) -> float:
        inside = middle
        # Bisection: 12 halvings resolve the ratio better than any catalogue of gears.
        for _ in range(12):
            candidate = (inside + outside) / 2.0
            has_same_verdict = (
                feasibility(_with_ratio(best, demand, candidate), demand, continuous).verdict
                == verdict
            )
            inside, outside = (candidate, outside) if has_same_verdict else (inside, candidate)
        return math.exp(inside)

    low, high = _log_ratio_bounds(best, demand)
    return edge(low), edge(high)


def _log_ratio_bounds(drive: Drive, demand: Demand) -> tuple[float, float]:
    """Return the logarithms of the lowest and highest ratio to try.

    Both are the drive's ratio if the ratio makes no difference. The lowest ratio of a rotary joint
    is 1: a gear does not raise the speed.
    """
    torque, speed = np.abs(demand.torque).max(), np.abs(demand.speed).max()
    if not torque * speed * drive.motor.back_emf_constant > 0.0:
        return -math.log(drive.arm_radius), -math.log(drive.arm_radius)
    middle = math.log(best_ratio(torque, speed, drive.motor))
    low = middle - _LOG_RATIO_RANGE if demand.linear else max(middle - _LOG_RATIO_RANGE, 0.0)
    return low, max(middle + _LOG_RATIO_RANGE, low + 1e-9)


def _with_ratio(drive: Drive, demand: Demand, logarithm: float) -> Drive:
    """Return the drive with a ratio of exp(logarithm), by its gear or a slide's wheel."""
    ratio = math.exp(logarithm)
    if demand.linear:
        return drive.replaced({"motor.arm_radius": drive.motor.gear_ratio / ratio})
    return drive.replaced({"motor.gear_ratio": ratio})
