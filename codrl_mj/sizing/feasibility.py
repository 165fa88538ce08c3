"""Feasibility of a demand on a motor: operating points at the rotor, and bounds with remedies."""

import dataclasses
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import Drive, GearMotor
from codrl_mj.sizing.joint_demand import Demand
from codrl_mj.sizing.limits import Number, max_power
from codrl_mj.sizing.swing import Swing, min_energy_gain, min_pumped_energy, min_supply_voltage


class OperatingPoints(NamedTuple):
    """Operating points at the rotor that a demand requires, over T steps."""

    torque: np.ndarray
    """Torque of the rotor [N*m], shape (T,)."""
    speed: np.ndarray
    """Speed of the rotor [rad/s], shape (T,)."""
    current: np.ndarray
    """Current [A], shape (T,)."""
    voltage: np.ndarray
    """Required voltage of the supply [V], shape (T,), >= 0."""
    rms_current: float
    """Root mean square of the current over the whole demand [A]."""
    copper_loss: float
    """Heat in the winding in an episode [J]."""
    energy_drawn: float
    """Electrical energy drawn in an episode [J]; returned energy is not subtracted."""
    own_share: float
    """Largest torque that rotor acceleration and friction take, over the largest torque of the
    load, both at the joint. A lower bound if the rotor's inertia is unknown (0).
    """


def operating_points(demand: Demand, drive: Drive) -> OperatingPoints:
    """Return the operating points of a motor for a demand.

    With N turns of the rotor for one turn of the joint (1/arm on a slide),

        tau_rotor = (tau + N^2 (J alpha + b omega) + N tau_c sign(omega)) / (N eta)
        i = tau_rotor / kT
        V >= |R i + L di/dt + N kE omega| + R_supply |i|, with and without L di/dt.

    tau_c includes Stribeck friction. di is the change of the current from the step before, which
    may be the last one of the previous episode. If the motor brakes or holds, eta is 1: the losses
    of the gear then help, and are ignored. Energies use the mean speed in a step, all other values
    the speed at its start.

    Raises:
        ValueError: the drive has the part `friction`.
    """
    if drive.friction is not None:
        raise ValueError(
            "friction: the sizing of motors takes no friction that depends on the load; remove"
            " friction, and set motor.coulomb_friction, motor.viscous_friction and"
            " motor.gear_efficiency instead"
        )
    motor, added, arm = drive.motor, drive.additions, drive.arm_radius
    stribeck = motor.stribeck(demand.speed / arm) / arm
    own_torque = added.armature * demand.acceleration + added.damping * demand.speed
    own_torque = own_torque + (added.friction + stribeck) * np.sign(demand.speed)
    joint = demand.torque + own_torque
    torque = arm * joint / np.where(joint * demand.speed > 0.0, motor.gear_efficiency, 1.0)
    speed, current = demand.speed / arm, torque / motor.torque_constant
    terminal = motor.resistance * current + motor.back_emf_constant * speed
    changing = terminal + motor.inductance * np.diff(current, prepend=current[:1]) / demand.duration
    mean_speed = speed + demand.acceleration * demand.duration / (2.0 * arm)
    power = (motor.resistance * current + motor.back_emf_constant * mean_speed) * current
    square = float(current**2 @ demand.duration)
    return OperatingPoints(
        torque=torque,
        speed=speed,
        current=current,
        voltage=np.maximum(np.abs(terminal), np.abs(changing))
        + drive.supply_resistance * np.abs(current),
        rms_current=math.sqrt(square / float(demand.duration.sum())),
        copper_loss=motor.resistance * square / demand.episodes,
        energy_drawn=float(np.maximum(power, 0.0) @ demand.duration) / demand.episodes,
        own_share=float(np.abs(own_torque).max() / max(np.abs(demand.torque).max(), 1e-300)),
    )


def best_ratio(torque: Number, speed: Number, motor: GearMotor) -> Number:
    """Return the gear ratio N that needs the lowest voltage for a torque [N*m] and a speed [rad/s].

    It minimizes R tau/(N kT) + N kE omega over N, without rotor inertia and friction; the minimum
    is 2 N kE omega.
    """
    ratio: Number = np.sqrt(
        motor.resistance * torque / (motor.torque_constant * motor.back_emf_constant * speed)
    )
    return ratio


# -- bounds ----------------------------------------------------------------------------------------

SURELY = "surely"
DEPENDS = "it depends"
TRY_IT = "try it"
HOPELESS = "hopeless"
SURELY_NOT = "surely not"
VERDICTS = (SURELY, DEPENDS, TRY_IT, HOPELESS, SURELY_NOT)
"""Verdicts, from best to worst."""
SUFFICIENT = ("voltage", "current", "heat", "rotor", "friction")
"""Bounds that are sufficient together."""
MAX_ROTOR_SHARE = 0.5
"""Largest torque for rotor and friction, over the largest torque of the load. A policy has to
command both together, and the task limits its command.
"""
MAX_FRICTION_SHARE = 0.05
"""Largest Coulomb friction at the joint, over the largest torque of the load. With this much
friction, policies trained without it lost at most 0.05 of the score on five tasks and 0.10 on
Mountain Car; with twice as much, up to 0.18 (docs/results/actuators.md).
"""
HOPELESS_RATIO = 10.0
"""Ratio of needed to available above which a motor is hopeless. In simulations, no motor with a
ratio above 7 succeeded.
"""
MAX_PEAK_SHARE = 0.01
"""Share of time in which peaks are ignored: a policy can avoid them, for example at an impact."""


@dataclasses.dataclass(frozen=True)
class Bound:
    """Condition on a motor, with its verdict."""

    name: str
    """Name of the bound."""
    formula: str
    """Formula of the quantity whose `needed` value must not exceed the `available` one."""
    needed: float
    """Value that the demand needs."""
    available: float
    """Value that the motor has."""
    unit: str
    """Unit of `needed` and `available`."""
    holds: bool
    """True if the motor meets the condition."""
    verdict: str
    """`surely`, `surely not` or, without a conclusion, `try it`; `hopeless` if the shortage is
    large; `it depends` if `needed` or `available` is unknown (NaN).
    """
    remedy: str
    """Change, or missing number, that would meet the condition; empty if it is met."""

    def __str__(self) -> str:
        """Return the bound as a sentence."""
        if self.verdict == DEPENDS:
            return f"{self.name}: {self.remedy}"
        text = (
            f"{self.name}: {self.formula}, needs {self.needed:.4g} {self.unit}, has"
            f" {self.available:.4g} {self.unit}"
        )
        return text if self.holds else f"{text}: {self.remedy}"


@dataclasses.dataclass(frozen=True)
class Feasibility:
    """Judgment whether a motor can meet a demand, with its reasons."""

    bounds: tuple[Bound, ...]
    """All applicable bounds."""
    operating_points: OperatingPoints
    """Operating points of the motor."""
    margin: float
    """Smallest reserve of voltage, peak and rms current; see `margin`."""

    @property
    def verdict(self) -> str:
        """Verdict: `surely not` or `hopeless` of any bound, or else the worst of `SUFFICIENT`."""
        worst = max((bound.verdict for bound in self.bounds), key=VERDICTS.index)
        if worst in (HOPELESS, SURELY_NOT):
            return worst
        return max(
            (bound.verdict for bound in self.bounds if bound.name in SUFFICIENT), key=VERDICTS.index
        )

    @property
    def shortage(self) -> float:
        """Largest ratio of needed to available among `SUFFICIENT`; above 1 if one is not met."""
        known = (b.needed / max(b.available, 1e-300) for b in self.bounds if b.name in SUFFICIENT)
        return max(ratio for ratio in known if not math.isnan(ratio))

    @property
    def reason(self) -> str:
        """Sentences on unmet or unknown bounds, the decisive one first; empty if there is none."""
        return ". ".join(map(str, self.failed_bounds))

    @property
    def failed_bounds(self) -> list[Bound]:
        """Unmet or unknown bounds, the decisive one first."""
        return sorted(
            (b for b in self.bounds if not b.holds), key=lambda b: -VERDICTS.index(b.verdict)
        )


def margin(drive: Drive, required: OperatingPoints, continuous_current: float | None) -> float:
    """Return the smallest reserve of voltage, peak and rms current, as a share of its limit.

    It is negative if a limit is exceeded.
    """
    return 1.0 - max(
        float(required.voltage.max()) / drive.voltage_limit,
        float(np.abs(required.current).max()) / drive.controller.max_current,
        required.rms_current / continuous_current if continuous_current else 0.0,
    )


def feasibility(
    drive: Drive, demand: Demand, continuous_current: float | None = None
) -> Feasibility:
    """Judge whether a motor can meet a demand.

    The bounds of `SUFFICIENT` are sufficient together. `stall` and `power` are necessary to follow
    the demand exactly, so they exclude a motor if the demand is exact. Otherwise another policy may
    need less: then only `stall` can exclude a motor, if it has no torque at standstill. `swing` is
    necessary for every policy.

    Args:
        drive: motor with gear and supply; a rotor inertia of 0 counts as unknown.
        demand: demand of the joint.
        continuous_current: continuous current of the winding [A]; None if unknown.

    Raises:
        ValueError: the actuator is not a `Drive`.
    """
    if not isinstance(drive, Drive):
        raise ValueError(
            f"{drive!r}: must be a codrl_mj.actuators.Drive, a motor with gear and supply;"
            " codrl_mj.sizing.find_drive returns one for a name"
        )
    required = operating_points(demand, drive)
    unmet_verdict = SURELY_NOT if demand.exact else TRY_IT
    bounds = []
    conditions = _conditions(drive, demand, required, continuous_current, unmet_verdict)
    for name, formula, load, available, unit, verdicts, remedy in conditions:
        needed = float(np.max(load))
        holds = needed <= available
        # Heat grows with the squared current: 10 times the heat is sqrt(10) times the current.
        verdict = verdicts[not holds]
        hopeless_limit = available * (
            math.sqrt(HOPELESS_RATIO) if name == "heat" else HOPELESS_RATIO
        )
        # A shortage that occurs only during brief peaks is not hopeless.
        lasting = float(np.quantile(load, 1.0 - MAX_PEAK_SHARE))
        if (
            name in _MAY_BE_HOPELESS
            and not holds
            and verdict == TRY_IT
            and lasting >= hopeless_limit
            and not demand.servo
        ):
            verdict = HOPELESS
        if math.isnan(available):
            verdict = DEPENDS
        elif demand.servo and name in _EASED_BY_SERVO:
            remedy = "a servo asks for less if the motor is slower: evaluate the run on this motor"
        bounds.append(
            Bound(name, formula, needed, available, unit, holds, verdict, "" if holds else remedy)
        )
    if drive.motor.rotor_inertia == 0.0 and all(
        bound.holds for bound in bounds if bound.name == "rotor"
    ):
        unknown = _unknown_rotor(drive, demand, continuous_current)
        bounds = [bound for bound in bounds if bound.name != "rotor"] + unknown
    if demand.swing is not None:
        bounds += _swing_bounds(drive, demand.swing)
    return Feasibility(tuple(bounds), required, margin(drive, required, continuous_current))


_MAY_BE_HOPELESS = ("voltage", "current", "heat", "stall")
"""Bounds whose shortage can be hopeless; not power, because a policy may move more slowly."""
_EASED_BY_SERVO = ("voltage", "current", "rotor", "power")
"""Bounds whose needed value a position or velocity servo lowers: on an ideal motor it moves as
fast as its force allows, on a real motor it moves more slowly and needs less.
"""


class _Condition(NamedTuple):
    """Condition on a motor that has not been judged yet."""

    name: str
    formula: str
    load: float | np.ndarray  # loads, of which the largest must not exceed the available value
    available: float
    unit: str
    verdicts: tuple[str, str]  # if it holds, and if not
    remedy: str


def _conditions(
    drive: Drive,
    demand: Demand,
    required: OperatingPoints,
    continuous: float | None,
    unmet_verdict: str,
) -> Iterator[_Condition]:
    """Yield the conditions of the general bounds.

    Sufficient together: voltage and current at every operating point, heat and, unless the demand
    is exact, the shares of rotor and friction. Necessary to follow the demand exactly: torque at
    standstill, and power with any gear.
    """
    motor, limit, max_current = drive.motor, drive.voltage_limit, drive.controller.max_current
    currents, unit = np.abs(required.current), "N" if demand.linear else "N*m"
    volts, largest = float(required.voltage.max()), float(currents.max())
    remedy = f"raise the supply to {volts:.4g} V{_time_within(required.voltage, limit, 'V')}"
    yield _Condition(
        "voltage",
        "|R i + L di/dt + N kE omega|, largest",
        required.voltage,
        limit,
        "V",
        (SURELY, unmet_verdict),
        remedy,
    )
    remedy = (
        f"raise controller.max_current to {largest:.4g} A, or the gear"
        f" {largest / max_current:.3g} times"
    )
    remedy += _time_within(currents, max_current, "A")
    yield _Condition(
        "current", "|i|, largest", currents, max_current, "A", (SURELY, unmet_verdict), remedy
    )
    rating = math.nan
    remedy = f"its continuous current is not known, must be at least {required.rms_current:.3g} A"
    if continuous is not None:
        rating = continuous
        remedy = (
            f"let it rest, cool it, or raise the gear {required.rms_current / continuous:.3g} times"
        )
    yield _Condition("heat", "i, rms", required.rms_current, rating, "A", (SURELY, TRY_IT), remedy)
    if not demand.exact:
        yield from _share_bounds(drive, demand, required)
    # Where power < 0 the motor brakes, which needs less than driving.
    power = demand.torque * demand.speed
    driving = np.where(power >= 0.0, np.abs(demand.torque), 0.0)
    current = min(limit / (motor.resistance + drive.supply_resistance), max_current)
    stall_torque = (
        motor.torque_constant * motor.gear_efficiency * current / drive.arm_radius
        - drive.additions.friction
    )
    stall_torque -= motor.stribeck_friction / drive.arm_radius
    verdicts = TRY_IT, unmet_verdict if stall_torque > 0.0 else SURELY_NOT
    remedy = "raise the supply, the largest current or the gear"
    yield _Condition(
        "stall", "|tau| except braking, largest", driving, stall_torque, unit, verdicts, remedy
    )
    peak = int(np.argmax(power))
    torque = abs(float(demand.torque[peak])) / motor.gear_efficiency
    speed = abs(float(demand.speed[peak]))
    min_voltage = 0.0
    # The lowest voltage [V] that delivers the largest power with the best gear.
    if torque * speed * motor.back_emf_constant > 0.0:
        min_voltage = (
            2.0 * float(best_ratio(torque, speed, motor)) * motor.back_emf_constant * speed
        )
        min_voltage *= math.sqrt(1.0 + drive.supply_resistance / motor.resistance)
    needed = float(power.max(initial=0.0)) / motor.gear_efficiency
    remedy = (
        f"no gear helps: raise the supply to {min_voltage:.4g} V and the largest current, or take a"
        " stronger motor"
    )
    remedy = remedy if demand.exact else f"to follow this run exactly, {remedy}"
    yield _Condition(
        "power",
        "tau omega / eta, largest",
        needed,
        max_power(drive),
        "W",
        (TRY_IT, unmet_verdict),
        remedy,
    )


def _time_within(load: np.ndarray, available: float, unit: str) -> str:
    """Return text with the share of steps in which the available value suffices."""
    return (
        f" ({available:.4g} {unit} suffice for"
        f" {math.floor(100.0 * float(np.mean(load <= available)))}% of the time)"
    )


def _share_bounds(drive: Drive, demand: Demand, required: OperatingPoints) -> Iterator[_Condition]:
    """Yield the bounds on the shares of the largest load that rotor and friction take."""
    # With x times the gear ratio, the inertial part grows by x^2 and the friction by x. The scale
    # is the positive root of inertial*x^2 + friction*x = MAX_ROTOR_SHARE.

    friction = friction_share(drive, demand)
    inertial = max(required.own_share - friction, 1e-9)
    scale = (math.sqrt(friction * friction + 4.0 * inertial * MAX_ROTOR_SHARE) - friction) / (
        2.0 * inertial
    )
    rows = (
        (
            "rotor",
            "rotor and friction",
            required.own_share,
            MAX_ROTOR_SHARE,
            scale,
            "let policies command voltage",
        ),
        (
            "friction",
            "Coulomb friction",
            friction,
            MAX_FRICTION_SHARE,
            MAX_FRICTION_SHARE / max(friction, 1e-300),
            "train with it",
        ),
    )
    for name, formula, share, limit, scale_of_gear, alternative in rows:
        gear = scale_of_gear / drive.arm_radius
        remedy = (
            f"lower the gear to {gear:.3g}"
            if demand.linear or gear >= 1.0
            else "take a smaller motor"
        )
        formula, remedy = f"{formula}, share of the largest load", f"{remedy}, or {alternative}"
        yield _Condition(name, formula, 100.0 * share, 100.0 * limit, "%", (SURELY, TRY_IT), remedy)


def friction_share(drive: Drive, demand: Demand) -> float:
    """Return the share of the largest load taken by Coulomb friction at the joint."""
    return drive.additions.friction / max(float(np.abs(demand.torque).max()), 1e-300)


def _unknown_rotor(drive: Drive, demand: Demand, continuous: float | None) -> list[Bound]:
    """Return the bound on an unknown rotor inertia; none if even 1 kg*m^2 is light enough."""

    def is_light_enough(inertia: float) -> bool:
        heavier = drive.replaced({"motor.rotor_inertia": inertia})
        required = operating_points(demand, heavier)
        return margin(heavier, required, continuous) >= 0.0 and (
            demand.exact or required.own_share <= MAX_ROTOR_SHARE
        )

    low, high = 1e-12, 1.0
    if is_light_enough(high):
        return []
    remedy, max_inertia = "its inertia is not known: give rotor_inertia", math.nan
    if is_light_enough(low):
        # Bisection on a logarithmic scale.
        while high > 1.001 * low:
            middle = math.sqrt(low * high)
            low, high = (middle, high) if is_light_enough(middle) else (low, middle)
        remedy, max_inertia = f"{remedy}, must be at most {low:.3g} kg*m^2 at the motor", low
    return [
        Bound(
            "rotor", "inertia of the rotor", math.nan, max_inertia, "kg*m^2", False, DEPENDS, remedy
        )
    ]


def _swing_bounds(drive: Drive, swing: Swing) -> list[Bound]:
    """Return the bounds on the energy of every swing of a swing-up."""
    # The pumped energy is an estimate, which cannot exclude a motor; only the exact bound can.
    bounds = []
    for name, formula, energy, unmet in (
        ("pumping", "energy gained in a swing, smallest", min_pumped_energy, TRY_IT),
        ("swing", "energy gained from rest to rest, smallest", min_energy_gain, SURELY_NOT),
    ):
        energy_gain, remedy = energy(swing, drive), ""
        if energy_gain <= 0.0:
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
                energy_gain,
                "J",
                energy_gain > 0.0,
                TRY_IT if energy_gain > 0.0 else unmet,
                remedy,
            )
        )
    return bounds
