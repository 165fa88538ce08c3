"""What a demand asks of a motor at its shaft, and what follows of it without a simulation: bounds, with remedies."""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from codrl_mj.actuators import Drive, GearMotor
from codrl_mj.sizing.abilities import max_power
from codrl_mj.sizing.demand import Demand
from codrl_mj.sizing.swing import Swing, min_energy_gain, min_pumped_energy, min_supply_voltage


class Operation(NamedTuple):
    """A demand as the rotor sees it, over T steps."""

    torque: np.ndarray
    """The rotor's [N*m], shape (T,)."""
    speed: np.ndarray
    """The rotor's [rad/s], shape (T,)."""
    current: np.ndarray
    """[A], shape (T,)."""
    voltage: np.ndarray
    """That the supply has to have [V], shape (T,), >= 0."""
    rms_current: float
    """Over the whole demand [A]."""
    copper_loss: float
    """Heat in the winding in an episode [J]."""
    energy_drawn: float
    """Electrical energy drawn from the supply in an episode [J], what comes back not taken off."""
    own_share: float
    """Largest torque that rotor and friction take, over the largest that the joint is asked for; at
    least that, where the rotor's inertia is unknown and thus 0.
    """


def operation(demand: Demand, drive: Drive) -> Operation:
    """What a demand asks of a motor.

    With N turns of the rotor for one of the joint (1/arm on a slide),

        tau_rotor = (tau + N^2 (J alpha + b omega) + N tau_c sign(omega)) / (N eta),   i = tau_rotor
        / kT, V >= |R i + N kE omega| + R_supply |i|, and with L di/dt while i comes from its value
        in the step before.

    with Stribeck friction in tau_c. A change of the torque is to be made within a step of the
    demand; so is that from one episode to the next. Where the motor brakes or holds, eta is 1: the
    gear helps then. Energies are of the mean speed in a step, all else of that at its start.
    """
    motor, added, arm = drive.motor, drive.additions, drive.arm_radius
    sticking = motor.stribeck(demand.speed / arm) / arm
    own = added.armature * demand.acceleration + added.damping * demand.speed
    own = own + (added.friction + sticking) * np.sign(demand.speed)
    joint = demand.torque + own
    torque = arm * joint / np.where(joint * demand.speed > 0.0, motor.gear_efficiency, 1.0)
    speed, current = demand.speed / arm, torque / motor.torque_constant
    terminal = motor.resistance * current + motor.back_emf_constant * speed
    changing = terminal + motor.inductance * np.diff(current, prepend=current[:1]) / demand.duration
    mean_speed = speed + demand.acceleration * demand.duration / (2.0 * arm)
    power = (motor.resistance * current + motor.back_emf_constant * mean_speed) * current
    square = float(current**2 @ demand.duration)
    return Operation(
        torque=torque,
        speed=speed,
        current=current,
        voltage=np.maximum(np.abs(terminal), np.abs(changing)) + drive.sag * np.abs(current),
        rms_current=math.sqrt(square / float(demand.duration.sum())),
        copper_loss=motor.resistance * square / demand.episodes,
        energy_drawn=float(np.maximum(power, 0.0) @ demand.duration) / demand.episodes,
        own_share=float(np.abs(own).max() / max(np.abs(demand.torque).max(), 1e-300)),
    )


def best_ratio(torque: Any, speed: Any, motor: GearMotor) -> Any:
    """The gear N at which a torque [N*m] at a speed [rad/s] takes the least voltage, 2 N kE omega.

    The minimum of R tau/(N kT) + N kE omega over N; rotor and friction are not in it.
    """
    return np.sqrt(
        motor.resistance * torque / (motor.torque_constant * motor.back_emf_constant * speed)
    )


# -- what follows ---------------------------------------------------------------------------------------------------

SURELY, DEPENDS, TRY_IT, HOPELESS, SURELY_NOT = (
    "surely",
    "it depends",
    "try it",
    "hopeless",
    "surely not",
)
VERDICTS = (SURELY, DEPENDS, TRY_IT, HOPELESS, SURELY_NOT)
"""From the best."""
SUFFICIENT = ("voltage", "current", "heat", "rotor", "friction")
"""The bounds that suffice together."""
MAX_ROTOR_SHARE = 0.5
"""Largest share that rotor and friction may take of the largest load: in a task a policy can ask for no more."""
MAX_FRICTION_SHARE = 0.05
"""Largest share that Coulomb friction at the joint may take of it. Policies that never met as much
lost at most 0.05 of the score on five tasks and 0.10 on Mountain Car, and with twice as much up to
0.18 (docs/results/actuators.md).
"""
SHORT = 10.0
"""What is short by this factor is hopeless: in simulations none that was short by more than 7 got anywhere."""
BRIEF = 0.01
"""Share of the time in which more than that may be short: a policy can do without a peak, such as at an impact."""


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
    """`surely`, `surely not`, or where nothing follows `try it`; `hopeless` where most of it is
    missing; `it depends` where one of the sides is not known, and NaN.
    """
    remedy: str
    """Change or missing number that would make it hold; empty if it holds."""

    def __str__(self) -> str:
        """In a sentence."""
        if self.verdict == DEPENDS:
            return f"{self.name}: {self.remedy}"
        text = (
            f"{self.name}: {self.formula}, needs {self.needed:.4g} {self.unit}, has"
            f" {self.available:.4g} {self.unit}"
        )
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
        """`surely not` or `hopeless` if any bound says so; otherwise the worst of the bounds that suffice together."""
        worst = max((bound.verdict for bound in self.bounds), key=VERDICTS.index)
        if worst in (HOPELESS, SURELY_NOT):
            return worst
        return max(
            (bound.verdict for bound in self.bounds if bound.name in SUFFICIENT), key=VERDICTS.index
        )

    @property
    def shortage(self) -> float:
        """The largest of needed over available among the bounds that suffice together: above 1 where one fails."""
        known = (b.needed / max(b.available, 1e-300) for b in self.bounds if b.name in SUFFICIENT)
        return max(ratio for ratio in known if not math.isnan(ratio))

    @property
    def reason(self) -> str:
        """Return what is in the way or not known, the decisive first; empty if nothing is."""
        return ". ".join(map(str, self.failed_bounds))

    @property
    def failed_bounds(self) -> list[Bound]:
        """The bounds that do not hold or are not known, the decisive first."""
        return sorted(
            (b for b in self.bounds if not b.holds), key=lambda b: -VERDICTS.index(b.verdict)
        )


def margin(drive: Drive, asked: Operation, continuous_current: float | None) -> float:
    """The smallest share of voltage, largest current and continuous current that is left; below 0: what is missing."""
    return 1.0 - max(
        float(asked.voltage.max()) / drive.voltage_limit,
        float(np.abs(asked.current).max()) / drive.controller.max_current,
        asked.rms_current / continuous_current if continuous_current else 0.0,
    )


def feasibility(
    drive: Drive, demand: Demand, continuous_current: float | None = None
) -> Feasibility:
    """Judge whether a motor can deliver what a run asked of the ideal actuator.

    The bounds of `SUFFICIENT` suffice together. `stall` and `power` are necessary for the run, and
    so decide where the demand is exact; another policy may do a task with less. `swing` is
    necessary for any policy.

    Args:
        drive: the motor with gear and supply; a rotor inertia of 0 is taken as not known.
        demand: what is asked.
        continuous_current: that the winding bears for good [A]; None: not known.

    Raises:
        ValueError: the actuator is no `Drive`.
    """
    if not isinstance(drive, Drive):
        raise ValueError(
            f"{drive!r}: must be a codrl_mj.actuators.Drive, a motor with gear and supply, or a"
            " catalogue's name"
        )
    asked, unmet = operation(demand, drive), SURELY_NOT if demand.exact else TRY_IT
    bounds = []
    rows = _conditions(drive, demand, asked, continuous_current, unmet)
    for name, formula, load, available, unit, verdicts, remedy in rows:
        needed = float(np.max(load))
        holds = needed <= available
        verdict, most = (
            verdicts[not holds],
            available * (math.sqrt(SHORT) if name == "heat" else SHORT),
        )
        lasting = float(np.quantile(load, 1.0 - BRIEF))
        if (
            name in _HOPELESS
            and not holds
            and verdict == TRY_IT
            and lasting >= most
            and not demand.servo
        ):
            verdict = HOPELESS
        if math.isnan(available):
            verdict = DEPENDS
        elif demand.servo and name in _LATER:
            remedy = (
                "its servo asks for less where the motor is slower: evaluate the run on this motor"
            )
        bounds.append(
            Bound(name, formula, needed, available, unit, holds, verdict, "" if holds else remedy)
        )
    if drive.motor.rotor_inertia == 0.0 and all(
        bound.holds for bound in bounds if bound.name == "rotor"
    ):
        unknown = _unknown_rotor(drive, demand, continuous_current)
        bounds = [bound for bound in bounds if bound.name != "rotor"] + unknown
    if demand.swing is not None:
        bounds += _swinging(drive, demand.swing)
    return Feasibility(tuple(bounds), asked, margin(drive, asked, continuous_current))


_HOPELESS = ("voltage", "current", "heat", "stall")
"""The bounds that may be so short that a task is hopeless; over power a policy may take its time."""
_LATER = ("voltage", "current", "rotor", "power")
"""The bounds on what a servo asks for on ideal motors, where it is as fast as its force allows."""
_Row = tuple[str, str, Any, float, str, tuple[str, str], str]


def _conditions(
    drive: Drive, demand: Demand, asked: Operation, continuous: float | None, unmet: str
) -> Iterator[_Row]:
    """Yield name, formula, load over time, available, unit, verdicts and remedy of each bound but a swing-up's.

    Voltage and current at every operating point, the heat of all of them, and of a task what rotor
    and friction leave suffice; torque at standstill, and power whatever the gear, are what any
    motor needs to deliver the run.
    """
    motor, limit, most = drive.motor, drive.voltage_limit, drive.controller.max_current
    currents, unit = np.abs(asked.current), "N" if demand.linear else "N*m"
    volts, largest = float(asked.voltage.max()), float(currents.max())
    remedy = f"raise the supply to {volts:.4g} V{_time_within(asked.voltage, limit, 'V')}"
    yield (
        "voltage",
        "|R i + L di/dt + N kE omega|, largest",
        asked.voltage,
        limit,
        "V",
        (SURELY, unmet),
        remedy,
    )
    remedy = (
        f"raise controller.max_current to {largest:.4g} A, or the gear {largest / most:.3g} times"
    )
    remedy += _time_within(currents, most, "A")
    yield "current", "|i|, largest", currents, most, "A", (SURELY, unmet), remedy
    bears, remedy = (
        math.nan,
        f"its continuous current is not known, must be at least {asked.rms_current:.3g} A",
    )
    if continuous is not None:
        bears = continuous
        remedy = (
            f"let it rest, cool it, or raise the gear {asked.rms_current / continuous:.3g} times"
        )
    yield "heat", "i, rms", asked.rms_current, bears, "A", (SURELY, TRY_IT), remedy
    if not demand.exact:
        yield from _taken(drive, demand, asked)
    power = demand.torque * demand.speed
    driving = np.where(power >= 0.0, np.abs(demand.torque), 0.0)
    current = min(limit / (motor.resistance + drive.sag), most)
    still = (
        motor.torque_constant * motor.gear_efficiency * current / drive.arm_radius
        - drive.additions.friction
    )
    still -= motor.stribeck_friction / drive.arm_radius
    verdicts = TRY_IT, unmet if still > 0.0 else SURELY_NOT
    remedy = "raise the supply, the largest current or the gear"
    yield "stall", "|tau| but of braking, largest", driving, still, unit, verdicts, remedy
    at = int(np.argmax(power))
    torque, speed, least = (
        abs(float(demand.torque[at])) / motor.gear_efficiency,
        abs(float(demand.speed[at])),
        0.0,
    )
    if (
        torque * speed * motor.back_emf_constant > 0.0
    ):  # what the largest power takes at any gear [V]
        least = 2.0 * float(best_ratio(torque, speed, motor)) * motor.back_emf_constant * speed
        least *= math.sqrt(1.0 + drive.sag / motor.resistance)
    needed = float(power.max(initial=0.0)) / motor.gear_efficiency
    remedy = (
        f"no gear helps: raise the supply to {least:.4g} V and the largest current, or take a"
        " stronger motor"
    )
    remedy = remedy if demand.exact else f"to follow this very run {remedy}"
    yield (
        "power",
        "tau omega / eta, largest",
        needed,
        max_power(drive),
        "W",
        (TRY_IT, unmet),
        remedy,
    )


def _time_within(load: np.ndarray, available: float, unit: str) -> str:
    """Say for how much of the time a motor has what is needed."""
    return (
        f" ({available:.4g} {unit} suffice for"
        f" {math.floor(100.0 * float(np.mean(load <= available)))}% of the time)"
    )


def _taken(drive: Drive, demand: Demand, asked: Operation) -> Iterator[_Row]:
    """Yield the bounds on the shares of a task's largest load that rotor and friction take.

    At x times the gear they take x^2 times the inertia's part and x times the friction's.
    """
    rubbed = friction_share(drive, demand)
    inertial = max(asked.own_share - rubbed, 1e-9)
    scale = (math.sqrt(rubbed * rubbed + 4.0 * inertial * MAX_ROTOR_SHARE) - rubbed) / (2.0 * inertial)
    rows = (
        (
            "rotor",
            "rotor and friction",
            asked.own_share,
            MAX_ROTOR_SHARE,
            scale,
            "let policies command voltage",
        ),
        (
            "friction",
            "Coulomb friction",
            rubbed,
            MAX_FRICTION_SHARE,
            MAX_FRICTION_SHARE / max(rubbed, 1e-300),
            "train with it",
        ),
    )
    for name, formula, taken, most, times, otherwise in rows:
        gear = times / drive.arm_radius
        remedy = (
            f"lower the gear to {gear:.3g}"
            if demand.linear or gear >= 1.0
            else "take a smaller motor"
        )
        formula, remedy = f"{formula}, share of the largest load", f"{remedy}, or {otherwise}"
        yield name, formula, 100.0 * taken, 100.0 * most, "%", (SURELY, TRY_IT), remedy


def friction_share(drive: Drive, demand: Demand) -> float:
    """Return the share of the largest load that Coulomb friction at the joint takes."""
    return drive.additions.friction / max(float(np.abs(demand.torque).max()), 1e-300)


def _unknown_rotor(drive: Drive, demand: Demand, continuous: float | None) -> list[Bound]:
    """Return the bound on a rotor's inertia that is not known; none where any inertia does."""

    def suffices(inertia: float) -> bool:
        heavier = drive.replaced({"motor.rotor_inertia": inertia})
        asked = operation(demand, heavier)
        return margin(heavier, asked, continuous) >= 0.0 and (
            demand.exact or asked.own_share <= MAX_ROTOR_SHARE
        )

    low, high = 1e-12, 1.0
    if suffices(high):
        return []
    remedy, most = "its inertia is not known: give rotor_inertia", math.nan
    if suffices(low):
        while high > 1.001 * low:
            middle = math.sqrt(low * high)
            low, high = (middle, high) if suffices(middle) else (low, middle)
        remedy, most = f"{remedy}, must be at most {low:.3g} kg*m^2 at the motor", low
    return [
        Bound("rotor", "inertia of the rotor", math.nan, most, "kg*m^2", False, DEPENDS, remedy)
    ]


def _swinging(drive: Drive, swing: Swing) -> list[Bound]:
    """What a swing-up needs: energy from every swing."""
    bounds = []
    for name, formula, energy, unmet in (
        ("pumping", "energy from a swing, least", min_pumped_energy, TRY_IT),
        ("swing", "energy from rest to rest, least", min_energy_gain, SURELY_NOT),
    ):
        gained, remedy = energy(swing, drive), ""
        if gained <= 0.0:
            volts = min_supply_voltage(swing, drive, energy)
            remedy = (
                f"raise the supply to {volts:.3g} V"
                if math.isfinite(volts)
                else "raise the largest current"
            )
            remedy += ", or change the gear"
        bounds.append(
            Bound(
                name,
                formula,
                0.0,
                gained,
                "J",
                gained > 0.0,
                TRY_IT if gained > 0.0 else unmet,
                remedy,
            )
        )
    return bounds
