"""What follows of a motor and a demand without a simulation: bounds with their numbers, verdicts and remedies."""

import dataclasses
import math

import numpy as np

from codrl_mj.actuators import Drive
from codrl_mj.motor_design.drives import most_power
from codrl_mj.sizing.demand import Demand
from codrl_mj.sizing.operation import Operation, best_ratio, operation
from codrl_mj.sizing.swing import Swing, least_gain, least_pumped, least_voltage

SURELY, TRY_IT, HOPELESS, SURELY_NOT = "surely", "try it", "hopeless", "surely not"
VERDICTS = (SURELY, TRY_IT, HOPELESS, SURELY_NOT)
"""From the best."""
SHORT = 10.0
"""What is short by this factor is hopeless: in simulations none that was short by more than 7 got anywhere."""


@dataclasses.dataclass(frozen=True)
class Bound:
    """A condition, and what follows from whether it holds."""

    name: str
    """Of the bound."""
    formula: str
    """What has to be at most what the motor has."""
    needed: float
    """The left side."""
    available: float
    """The right side."""
    unit: str
    """Of both."""
    holds: bool
    """Whether the motor has what is needed."""
    verdict: str
    """`surely`, `surely not`, or where nothing follows `try it`; `hopeless` where most of it is missing."""
    remedy: str
    """What to change; empty where it holds."""

    def __str__(self) -> str:
        """In a sentence."""
        text = f"{self.name}: {self.formula}, needs {self.needed:.4g} {self.unit}, has {self.available:.4g} {self.unit}"
        return text if self.holds else f"{text}: {self.remedy}"


@dataclasses.dataclass(frozen=True)
class Feasibility:
    """Whether a motor can do a task."""

    bounds: tuple[Bound, ...]
    """All that apply."""
    operation: Operation
    """What the demand asks of the motor."""
    margin: float
    """The smallest of the margins of voltage, current and heat; see `margin`."""

    @property
    def verdict(self) -> str:
        """`surely not` or `hopeless` if one bound says so, `surely` if voltage, current and heat do, else `try it`."""
        worst = max((bound.verdict for bound in self.bounds), key=VERDICTS.index)
        if worst in (HOPELESS, SURELY_NOT):
            return worst
        return SURELY if self.margin >= 0.0 else TRY_IT

    @property
    def why(self) -> str:
        """What is in the way, the decisive first; empty where nothing is."""
        failed = sorted((b for b in self.bounds if not b.holds), key=lambda b: -VERDICTS.index(b.verdict))
        return ". ".join(map(str, failed))


def margin(drive: Drive, asked: Operation, continuous_current: float | None) -> float:
    """The smallest share of voltage, largest current and continuous current that is left; below 0: what is missing."""
    return 1.0 - max(
        float(asked.voltage.max()) / drive.voltage_limit,
        float(np.abs(asked.current).max()) / drive.controller.max_current,
        asked.rms_current / continuous_current if continuous_current else 0.0,
    )


def feasibility(drive: Drive, demand: Demand, continuous_current: float | None = None) -> Feasibility:
    """Whether a motor can deliver what a run asked of the ideal actuator.

    `voltage`, `current` and `heat` together suffice. `stall` and `power` are necessary for the run, and so decide where
    the demand is exact; another policy may do a task with less. `swing` is necessary for any policy.

    Args:
        drive: the motor with gear and supply.
        demand: what is asked.
        continuous_current: that the winding bears for good [A]; None: unknown, and heat is left out.

    Raises:
        ValueError: the actuator is no `Drive`.
    """
    if not isinstance(drive, Drive):
        raise ValueError(
            f"{drive!r}: must be a codrl_mj.actuators.Drive, a motor with gear and supply, or a catalogue's name"
        )
    asked, unmet = operation(demand, drive), SURELY_NOT if demand.exact else TRY_IT
    bounds = [*_limits(drive, asked, continuous_current, unmet), *_necessary(drive, demand, unmet)]
    if demand.swing is not None:
        bounds += _swinging(drive, demand.swing)
    return Feasibility(tuple(bounds), asked, margin(drive, asked, continuous_current))


def _limits(drive: Drive, asked: Operation, continuous_current: float | None, unmet: str) -> list[Bound]:
    """What suffices: voltage and current at every operating point, and the heat of all of them."""
    needed, limit = float(asked.voltage.max()), drive.voltage_limit
    remedy = f"raise the supply to {needed:.4g} V"
    bounds = [_bound("voltage", "|R i + L di/dt + N kE omega|, largest", needed, limit, "V", (SURELY, unmet), remedy)]
    largest, most = float(np.abs(asked.current).max()), drive.controller.max_current
    remedy = f"raise controller.max_current to {largest:.4g} A, or the gear {largest / most:.3g} times"
    bounds.append(_bound("current", "|i|, largest", largest, most, "A", (SURELY, unmet), remedy))
    if continuous_current is not None:
        needed = asked.rms_current
        remedy = f"let it rest, cool it, or raise the gear {needed / continuous_current:.3g} times"
        bounds.append(_bound("heat", "i, rms", needed, continuous_current, "A", (SURELY, TRY_IT), remedy))
    return bounds


def _necessary(drive: Drive, demand: Demand, unmet: str) -> list[Bound]:
    """What any motor needs to deliver the run: torque at standstill, and power, whatever the gear."""
    motor, limit, most = drive.motor, drive.voltage_limit, drive.controller.max_current
    power = demand.torque * demand.speed
    largest = float(np.abs(demand.torque[power >= 0.0]).max(initial=0.0))
    current = min(limit / motor.resistance, most)
    still = motor.torque_constant * motor.gear_efficiency * current / drive.arm_radius - drive.additions.friction
    still -= motor.stribeck_friction / drive.arm_radius
    needed = float(power.max(initial=0.0)) / motor.gear_efficiency
    least = _at_most_power(drive, demand)
    return [
        _bound(
            *("stall", "|tau| but of braking, largest", largest, still, "N" if demand.linear else "N*m"),
            (TRY_IT, unmet if still > 0.0 else SURELY_NOT),
            "raise the supply, the largest current or the gear",
        ),
        _bound(
            *("power", "tau omega / eta, largest", needed, most_power(drive), "W", (TRY_IT, unmet)),
            f"no gear helps: raise the supply to {least:.4g} V and the largest current, or take a stronger motor",
        ),
    ]


def _swinging(drive: Drive, swing: Swing) -> list[Bound]:
    """What a swing-up needs: energy from every swing."""
    bounds = []
    for name, formula, energy, unmet in (
        ("pumping", "energy from a swing, least", least_pumped, TRY_IT),
        ("swing", "energy from rest to rest, least", least_gain, SURELY_NOT),
    ):
        gained, remedy = energy(swing, drive), ""
        if gained <= 0.0:
            volts = least_voltage(swing, drive, energy)
            remedy = f"raise the supply to {volts:.3g} V" if math.isfinite(volts) else "raise the largest current"
            remedy += ", or change the gear"
        bounds.append(Bound(name, formula, 0.0, gained, "J", gained > 0.0, TRY_IT if gained > 0.0 else unmet, remedy))
    return bounds


def _bound(
    name: str, formula: str, needed: float, available: float, unit: str, verdicts: tuple[str, str], remedy: str
) -> Bound:
    """A bound with one of two verdicts, where it holds and where it does not; heat is by the square of the current."""
    holds = needed <= available
    verdict, most = verdicts[not holds], available * (math.sqrt(SHORT) if name == "heat" else SHORT)
    if not holds and verdict == TRY_IT and needed >= most and name != "power":  # a policy may take its time over it
        verdict = HOPELESS
    return Bound(name, formula, needed, available, unit, holds, verdict, "" if holds else remedy)


def _at_most_power(drive: Drive, demand: Demand) -> float:
    """The least voltage [V] that the demand's largest power takes at any gear; 0 without power."""
    motor = drive.motor
    at = int(np.argmax(demand.torque * demand.speed))
    torque, speed = abs(float(demand.torque[at])) / motor.gear_efficiency, abs(float(demand.speed[at]))
    if not torque * speed * motor.back_emf_constant > 0.0:
        return 0.0
    return 2.0 * float(best_ratio(torque, speed, motor)) * motor.back_emf_constant * speed
