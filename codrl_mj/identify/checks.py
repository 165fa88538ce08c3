"""Checks of a log before a fit, each registered with the conditions under which it applies."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from codrl_mj.actuators import GearMotor
from codrl_mj.identify.balances import (
    Balance,
    effort_lag,
    torque_balance,
    velocity_lag,
    voltage_balance,
)
from codrl_mj.identify.log import (
    GAP_STEPS,
    SIGNALS,
    Finding,
    Log,
    find_obstacle,
    find_resolution,
    find_turn_jumps,
    has_motion,
    is_servo_log,
    is_supply_voltage,
    replace_signal,
)
from codrl_mj.identify.parameters import PARAMETERS
from codrl_mj.identify.signal_checks import signal_findings

_DROPPED_STEPS = 1.5
"""Time step, in median steps, above which rows are missing."""
_MAX_LISTED = 10  # gaps that are reported one by one
# No motor of a robot exceeds these limits; 2e4 rad/s are 190,000 rpm. A duty is at most 1, but its
# rounding or scaling may make it slightly larger.
_MAX_VALUES = {
    "duty": 1.1,
    "voltage": 1e3,
    "bus": 1e3,
    "current": 1e3,
    "velocity": 2e4,
    "torque": 1e4,
}
"""Signal -> largest plausible value in SI units."""
FACTORS = {
    "degrees for radians": 180.0 / math.pi,
    "rpm for rad/s": 30.0 / math.pi,
    "turns for radians": 2.0 * math.pi,
    "thousandths for units, such as mA for A or ms for s": 1000.0,
    "hundredths for units, such as N*cm for N*m or percent for shares": 100.0,
    "kgf*cm for N*m": 10.197,
    "degrees for turns": 360.0,
    "rpm for turn/s": 60.0,
}
"""Mix-up of units -> factor that it causes between two values, or the inverse of that factor."""
# The smallest resistance would draw 1 kA at 5 V; micromotors have some hundreds of ohms.
_RESISTANCES = (5e-3, 1e4)
"""Range of plausible resistances of motors on a bench [ohm]."""
_MIN_T_VALUE = 10.0
"""Smallest coefficient over its standard error that counts as significant."""
_MAX_FLIPPED_RESIDUAL = 2.0 / 3.0
"""Largest ratio of the residual with a flipped sign to that with the logged sign, at which the
logged sign counts as wrong.
"""
_MAX_FLIPPED_RESIDUAL_ANYWHERE = 0.85
"""The same ratio for windows of any duration: above it, the sign is in doubt. Wrong signs of a real
pendulum's logs have 0.12 to 0.79; a joint of a double pendulum that the other one moves has 0.87
and 0.93 in short windows.
"""
_MAX_NOISE = 0.1
"""Noise-to-signal ratio above which no error of the velocity is reported."""
_SERVO = "this log has commands and positions of a servo, but no voltage, current or torque"
_MIN_TILT = 0.03
"""Smallest reported angle [rad] between the pendulum at rest and position 0."""


class LogFacts(NamedTuple):
    """A log to be checked, with values that several checks use."""

    log: Log
    motor: GearMotor | None  # motor of a datasheet
    rig: str | None
    effort: str  # logged torque, or else current, or else voltage; empty if there is none
    conditions: set[str]  # signals of the log, and conditions that it meets; see `check`
    winding: Balance | None  # R, L and kE from the voltage balance; None if it has no solution


Check = Callable[[LogFacts], Iterator[Finding]]
"""Function that yields what it finds in a log."""
CHECKS: list[tuple[set[str], Check]] = []
"""Conditions under which a check applies, and its function; checks run in this order."""


def _needs(words: str) -> Callable[[Check], Check]:
    """Return a decorator that registers a check with conditions, separated by spaces."""

    def add(function: Check) -> Check:
        CHECKS.append(({*words.split()}, function))
        return function

    return add


def check(log: Log, motor: GearMotor | None = None, rig: str | None = None) -> list[Finding]:
    """Return all findings about a log, errors first.

    Args:
        log: log, as read from its file.
        motor: motor of a datasheet to compare with; None skips the comparison.
        rig: `pendulum`, `free` or `load`; None is treated as `pendulum`.
    """
    # The torque is nearest to the shaft; current and voltage act on the shaft through the winding.
    effort = next((name for name in ("torque", "current", "voltage") if log.has(name)), "")
    conditions = {*log.signals, *(["effort"] if effort else []), *(["datasheet"] if motor else [])}
    if log.has("position") or log.has("velocity"):
        conditions |= {"motion", "moves" if has_motion(log) else "stands"}
    conditions |= {"hangs"} if rig in (None, "pendulum") else set()
    winding = voltage_balance(log) if log.has("voltage", "current") else None
    facts = LogFacts(log, motor, rig, effort, conditions, winding)
    findings = [
        *log.findings,
        *(
            finding
            for needs, function in CHECKS
            if needs <= conditions
            for finding in function(facts)
        ),
    ]
    order = ("error", "warning", "info")
    return sorted(findings, key=lambda finding: order.index(finding.severity))


def explain_factor(ratio: float, angle: bool = True) -> str:
    """Return possible causes of a wrong ratio: mixed-up units, a wrong scale or a gear.

    Mixed-up units are named if their factor is within 8 % of the ratio; units of angles only if
    `angle` is True.
    """
    size = abs(math.log(abs(ratio)))
    near = [
        f"{name} ({factor:.4g})"
        for name, factor in FACTORS.items()
        if abs(size - math.log(factor)) < 0.08 and (angle or "units" in name)
    ]
    return f"a factor of {math.exp(size):.4g}, " + " or ".join(
        [*near, "a wrong scale, another motor, or a gear"]
    )


@_needs("")
def _obstacle(facts: LogFacts) -> Iterator[Finding]:
    """Find the reason why a fit would reject this log."""
    if finding := find_obstacle([facts.log]):
        # A servo is identified from its commands and positions, without an input of its motor.
        if finding.check == "signals" and is_servo_log(facts.log):
            finding = dataclasses.replace(finding, severity="info", message=_SERVO)
        yield finding


@_needs("")
def _times(facts: LogFacts) -> Iterator[Finding]:
    """Find gaps, dropped rows, jitter, and time stamps in a wrong unit."""
    log, usual, rows = facts.log, facts.log.step, facts.log.row_numbers
    steps = np.diff(log.time)
    gaps = np.flatnonzero(steps > GAP_STEPS * usual)
    for row in gaps[:_MAX_LISTED]:
        text = (
            f"a gap of {steps[row]:.4g} s after {log.time[row]:.4g} s,"
            f" {steps[row] / usual:.0f} times the usual step"
        )
        yield Finding("warning", "gap", int(rows[row + 1]), text, "nothing is simulated across it")
    if gaps.size > _MAX_LISTED:
        yield Finding(
            "warning", "gap", None, f"{gaps.size - _MAX_LISTED} more gaps", "see the first ones"
        )
    dropped = np.flatnonzero((steps > _DROPPED_STEPS * usual) & (steps <= GAP_STEPS * usual))
    if dropped.size:
        missing = int(np.sum(np.round(steps[dropped] / usual) - 1.0))
        share = missing / (len(log.time) + missing)
        text = (
            f"{missing} rows missing ({share:.2g} of all) in {dropped.size} places, the first one"
            " here"
        )
        remedy = (
            "keep the time stamps, which the fit uses: with uniform steps the fit would be wrong"
        )
        severity = "warning" if share > 0.01 else "info"
        yield Finding(severity, "dropped rows", int(rows[dropped[0] + 1]), text, remedy)
    # Steps across missing rows are left out, because they would count as jitter.
    regular = steps[steps <= _DROPPED_STEPS * usual]
    jitter = float(np.std(regular)) / usual
    if jitter > 0.02:
        worst = int(
            np.argmax(np.where(steps <= _DROPPED_STEPS * usual, np.abs(steps - usual), 0.0))
        )
        text = (
            f"steps of {regular.min():.3g} to {regular.max():.3g} s around {usual:.3g} s,"
            f" with a standard deviation of {jitter:.0%}"
        )
        remedy = "take each time stamp when the values are read"
        yield Finding(
            "warning" if jitter > 0.3 else "info", "jitter", int(rows[worst + 1]), text, remedy
        )
    if not 2e-6 <= usual <= 0.5:
        text = f"a row every {usual:.3g} s is unusual: the unit of time is probably wrong"
        yield Finding("error", "unit", None, text, "write time=column:ms, or us, or ns")


@_needs("")
def _signals(facts: LogFacts) -> Iterator[Finding]:
    """Find faults of each signal by itself."""
    yield from signal_findings(facts.log)


@_needs("position")
def _wrapped(facts: LogFacts) -> Iterator[Finding]:
    """Find a position that jumps by a turn."""
    jumps = find_turn_jumps(facts.log.signals["position"], 2.0 * math.pi)
    if jumps.size:
        text = f"the position jumps by a turn, {jumps.size} times, first here"
        remedy = "write position=unwrap(column, 2*pi):rad, or unwrap(column, 360):deg"
        yield Finding("error", "wrapped", int(facts.log.row_numbers[jumps[0] + 1]), text, remedy)


@_needs("")
def _sizes(facts: LogFacts) -> Iterator[Finding]:
    """Find implausibly large values, voltages above the supply's, and a duty taken as voltage."""
    for signal in _MAX_VALUES.keys() & facts.log.signals.keys():
        # The quantile ignores outliers.
        largest = float(np.quantile(np.abs(facts.log.signals[signal]), 0.99))
        unit = SIGNALS[signal] or "times the bus voltage"
        if largest > _MAX_VALUES[signal]:
            text = (
                f"the {signal} is up to {largest:.4g} {unit}, must be at most"
                f" {_MAX_VALUES[signal]:g} {unit} on a bench"
            )
            example = "percent" if signal == "duty" else f"m{unit}"
            yield Finding(
                "error", "unit", None, text, f"correct its unit, such as {signal}=column:{example}"
            )
    if not facts.log.has("voltage"):
        return
    log, voltage = facts.log, np.abs(facts.log.signals["voltage"])
    responses = [log.signals[name] for name in ("current", "torque", "velocity") if log.has(name)]
    if log.has("position"):
        # Over many rows the motion is much larger than the quantization of an encoder.
        rows, position = max(len(log.time) // 20, 1), log.signals["position"]
        responses.append(position[rows:] - position[:-rows])
    if is_supply_voltage(log.signals["voltage"], responses):
        text = (
            f"the voltage stays near {np.median(voltage):.3g} V while the motor turns both ways: it"
            " is the voltage of the supply"
        )
        yield Finding(
            "error",
            "voltage",
            None,
            text,
            "write bus=column:V, and log the voltage at the motor or its duty",
        )
    if log.has("bus"):
        excess = voltage / np.maximum(np.abs(log.signals["bus"]), 1e-9)
        row = int(np.argmax(excess))
        if excess[row] >= 1.1:
            text = f"the voltage is up to {excess[row]:.3g} times that of the supply"
            remedy = "correct the scale of the duty, or of the bus"
            yield Finding("error", "unit", int(log.row_numbers[row]), text, remedy)
    elif facts.motor is None and (0.0 < voltage.max() <= 1.0 or voltage.max() > 100.0):
        guess = "a duty" if voltage.max() <= 1.0 else "a duty in percent, or in mV"
        text = f"the voltage is at most {voltage.max():.3g} V: is it {guess}?"
        remedy = (
            "if so, write voltage=duty*24:V, with a duty from -1 to 1 and the volts of the supply"
        )
        yield Finding("warning", "unit", None, text, remedy)


@_needs("position")
def _degrees(facts: LogFacts) -> Iterator[Finding]:
    """Find a position in degrees, by gravity or by an encoder whose step divides 360."""
    log, effort, remedy = facts.log, facts.effort, "write position=column:deg"
    if {"effort", "moves", "hangs"} <= facts.conditions:
        converted = replace_signal(log, "position", np.deg2rad(log.signals["position"]))
        radians, degrees = (
            torque_balance(variant, effort, is_tilted=True) for variant in (log, converted)
        )
        pulls = degrees is not None and degrees.t_values.get("gravity", 0.0) > _MIN_T_VALUE
        if (
            radians
            and degrees
            and pulls
            and degrees.residual < 0.5 * radians.residual
            and radians.unexplained > 0.1
        ):
            text = (
                "gravity acts as if the position were in degrees: degrees leave"
                f" {degrees.unexplained:.0%} of the {effort}"
            )
            text += f" unexplained, radians {radians.unexplained:.0%}"
            yield Finding("error", "unit", None, text, remedy)
            return
    step = log.resolution.get("position", 0.0) or find_resolution(log.signals["position"])
    if step > 0.0 and 8.0 < (steps_per_turn := 360.0 / step) < 1e5:
        count, radian_count = round(steps_per_turn), 2.0 * math.pi / step
        if (
            abs(steps_per_turn - count) < 1e-6 * steps_per_turn
            and abs(radian_count - round(radian_count)) > 1e-3
        ):
            text = (
                f"the position's steps of {step:.4g} are 1/{count} of 360, not of 2 pi: is it in"
                " degrees?"
            )
            # Radians rounded to decimals in a file have such steps, too: then it is only a warning.
            decimal = round(step / 10.0 ** math.floor(math.log10(step)), 5) in (1.0, 2.0, 2.5, 5.0)
            encoder = not decimal and (count % 100 == 0 or count & (count - 1) == 0)
            yield Finding("error" if encoder else "warning", "unit", None, text, remedy)


@_needs("position velocity moves")
def _velocity(facts: LogFacts) -> Iterator[Finding]:
    """Compare the velocity with the differentiated position."""
    shift = velocity_lag(facts.log)
    if shift is None:
        return
    clear = shift.noise < _MAX_NOISE
    if shift.unexplained > 0.5:
        text = (
            "velocity and differentiated position do not agree: the position leaves"
            f" {shift.unexplained:.0%} of the velocity unexplained"
        )
        if clear:
            yield Finding(
                "error", "velocity", None, text, "check both columns; leave the velocity out"
            )
        return
    if clear and shift.gain < 0.0:
        text = "the velocity is negative where the position increases"
        yield Finding(
            "error", "sign", None, text, "give one of them a minus: velocity=-column:unit"
        )
    # Noise of the position makes the gain of this regression too small, and noise of the velocity
    # makes the gain of the inverse regression too large. The true gain is between the two.
    ends = [math.log(abs(shift.gain)), math.log(abs(shift.gain) / (1.0 - shift.unexplained**2))]
    if clear and (min(ends) > 0.1 or max(ends) < -0.1):
        text = (
            f"the velocity is {abs(shift.gain):.4g} times the derivative of the position:"
            f" {explain_factor(shift.gain)}"
        )
        yield Finding("error", "unit", None, text, "correct the unit of velocity, position or time")
    rows = abs(shift.lag) / facts.log.step
    if (rows > 0.75 and shift.residual_ratio < 0.7) or (rows > 2.0 and shift.residual_ratio < 0.85):
        late = "after" if shift.lag > 0.0 else "before"
        text = (
            f"the velocity comes {1e3 * abs(shift.lag):.3g} ms {late} the differentiated position"
            f" ({rows:.2g} rows)"
        )
        remedy = "leave the velocity out, so that only the position is fitted"
        yield Finding("warning", "lag", None, text, remedy)


@_needs("voltage current")
def _electrical(facts: LogFacts) -> Iterator[Finding]:
    """Check the signs, the sizes and the significance of R, L and kE."""
    balance = facts.winding
    if balance is None:
        text = "voltage or current do not change, or too few rows follow each other without a gap"
        yield Finding(
            "error",
            "excitation",
            None,
            text,
            "log while the voltage changes; see codrl-mj identify plan",
        )
        return
    values, t_values = balance.values, balance.t_values
    if t_values["resistance"] < -_MIN_T_VALUE:
        text = (
            f"the resistance would be {values['resistance']:.3g} ohm: the current flows against the"
            " voltage"
        )
        yield Finding("error", "sign", None, text, "give one of them a minus: current=-column:A")
    elif (
        t_values["resistance"] > _MIN_T_VALUE
        and not _RESISTANCES[0] <= values["resistance"] <= _RESISTANCES[1]
    ):
        text = (
            f"the resistance would be {values['resistance']:.3g} ohm, outside {_RESISTANCES[0]:g}"
            " to 1e4 ohm"
        )
        remedy = "correct the unit of voltage or current: current=column:mA if it is in mA"
        yield Finding("error", "unit", None, text, remedy)
    elif t_values.get("back_emf_constant", 0.0) < -_MIN_T_VALUE:
        text = (
            f"the back-EMF constant would be {values['back_emf_constant']:.3g} V*s/rad: the speed"
            " has the opposite sign"
        )
        remedy = "give position and velocity a minus, or voltage and current"
        yield Finding("error", "sign", None, text, remedy)
    for name, change in (
        ("inductance", "in which the voltage changes quickly, such as a PRBS"),
        ("back_emf_constant", "in which the speed changes, such as a slow sine"),
    ):
        if name in values and abs(t_values[name]) < _MIN_T_VALUE:
            text = (
                f"the log hardly shows the {name.replace('_', ' ')}: its estimate is only"
                f" {abs(t_values[name]):.2g} times its standard error"
            )
            yield Finding(
                "info",
                "excitation",
                None,
                text,
                f"add a log {change}; or give the value with --known",
            )
    if balance.unexplained > 0.3:
        text = (
            f"R*i + L*di/dt + kE*speed leaves {balance.unexplained:.0%} of the voltage unexplained"
        )
        remedy = (
            "check that it is the voltage at the terminals, and that a row is written for each of"
            " its changes"
        )
        yield Finding("warning", "voltage", None, text, remedy)


@_needs("voltage current")
def _delay(facts: LogFacts) -> Iterator[Finding]:
    """Find a lag between the voltage and the current."""
    log, shift = facts.log, effort_lag(facts.log, "voltage")
    if shift is None or shift.unexplained > 0.3:
        return
    rows = shift.lag / log.step
    if abs(rows) >= 0.7 and shift.residual_ratio < 0.55:
        late = "after" if rows > 0.0 else "before"
        text = (
            f"the current comes {abs(rows):.2g} rows ({1e3 * abs(shift.lag):.3g} ms) {late} the"
            " voltage"
        )
        yield Finding(
            "warning",
            "lag",
            None,
            text,
            "check the delay that the fit reports, or shift a column of the log",
        )
    # A voltage sampled at a row represents the time from half a row before it to half a row after
    # it. The balance holds it until the next row, so that it seems to be half a row late.
    elif -0.8 < rows < -0.2 and shift.residual_ratio < 0.8:
        declared = (
            "as the mean until the next row" if log.mean_voltage else "as held until the next row"
        )
        text = (
            f"the voltage fits better about half a row earlier than {declared}: it was probably"
            " sampled at the time of the row"
        )
        remedy = "log the mean of the voltage, or a row for each of its changes"
        if log.mean_voltage:
            remedy = "write voltage=column:V without mean(); or log the mean"
        yield Finding("warning" if log.mean_voltage else "info", "voltage", None, text, remedy)


@_needs("voltage current")
def _sag(facts: LogFacts) -> Iterator[Finding]:
    """Find a supply whose voltage sags under load."""
    balance, share = facts.winding, np.abs(facts.log.signals["voltage"])
    # At a constant duty the supply's resistance cannot be distinguished from the winding's.
    sagging = (
        voltage_balance(facts.log, sag=True)
        if float(np.std(share)) > 0.1 * float(share.max())
        else None
    )
    if balance is None or sagging is None or sagging.residual > 0.96 * balance.residual:
        return
    supply, winding = sagging.values["supply_resistance"], sagging.values["resistance"]
    if sagging.t_values["supply_resistance"] > _MIN_T_VALUE and supply > 0.03 * winding > 0.0:
        text = (
            f"the voltage sags as if the supply had {supply:.2g} ohm, while the winding has"
            f" {winding:.2g} ohm"
        )
        remedy = "log the voltage of the supply, and write voltage=duty*bus:V"
        yield Finding("warning", "sag", None, text, remedy)


@_needs("effort moves")
def _mechanical(facts: LogFacts) -> Iterator[Finding]:
    """Check the signs of inertia and gravity, and that the motion follows from the torque."""
    log, effort, rig = facts.log, facts.effort, facts.rig
    # Shorter windows show more of the inertia in fast motions.
    balances = [
        fit
        for seconds in (0.3, 0.03)
        if (fit := torque_balance(log, effort, seconds, rig=rig)) is not None
    ]
    if not balances:
        return
    balance, t_values = balances[0], balances[0].t_values
    inertia_t_values = [fit.t_values.get("inertia", 0.0) for fit in balances]
    inertia_t = max(inertia_t_values, key=abs) if max(inertia_t_values) < 3.0 else 0.0
    is_negative = inertia_t < -_MIN_T_VALUE or (
        t_values.get("gravity", 0.0) < -_MIN_T_VALUE and inertia_t < -3.0
    )
    if is_negative and (finding := _explain_sign(log, effort, rig)):
        yield finding
    elif {"position", "hangs"} <= facts.conditions:
        yield from _zero(torque_balance(log, effort, is_tilted=True), effort)
    # A smaller residual may come from the quantization of a torque that changes fast.
    min_residual = 0.08 * float(np.std(log.signals[effort]))
    if effort == "torque" and balance.unexplained > 0.25 and balance.residual > min_residual:
        text = (
            f"the motion leaves {balance.unexplained:.0%} of the torque unexplained (mean over"
            " 0.3 s)"
        )
        lag = effort_lag(log, effort)
        if lag is not None and abs(lag.lag) > log.step and lag.residual_ratio < 0.9:
            text += f"; {lag.unexplained:.0%} if the motion came {1e3 * lag.lag:.3g} ms later"
        remedy = (
            "something else moves the shaft, or the columns were not sampled at the same time:"
            " trust this log less than others"
        )
        yield Finding("warning", "torque", None, text, remedy)


def _explain_sign(log: Log, effort: str, rig: str | None) -> Finding | None:
    """Return a finding if the effort fits better with a flipped sign; None if it does not.

    Standard errors alone may mislead if static friction holds the shaft, or if a controller
    computes the effort from the motion. If another joint moves this one, a flipped sign explains
    the effort better only over long windows, because the inertia that matters in short ones is
    still accelerated by the effort as it was logged.
    """
    shares, is_doubtful = "", False
    for seconds in (0.3, 0.03):
        original, flipped = (
            torque_balance(log, effort, seconds, rig=rig, sign=sign) for sign in (1.0, -1.0)
        )
        # Nothing is reported if the logged sign explains the effort well.
        if original is None or flipped is None or original.unexplained < 0.03:
            continue
        if flipped.residual < _MAX_FLIPPED_RESIDUAL * original.residual:
            shares = shares or (
                f"{original.unexplained:.1%} of it unexplained, with a minus"
                f" {flipped.unexplained:.2%}"
            )
        is_doubtful |= flipped.residual > _MAX_FLIPPED_RESIDUAL_ANYWHERE * original.residual
    if not shares:
        return None
    if is_doubtful:
        text = (
            f"something else moves the shaft, such as another joint: inertia and friction leave"
            f" {shares}, but not over windows of another duration"
        )
        remedy = (
            f"leave the sign of the {effort}, and log this joint while the others are held: a fit"
            " of one joint would be wrong with either sign"
        )
        return Finding("warning", "torque", None, text, remedy)
    text = (
        f"the {effort} accelerates the wrong way: inertia and friction leave {shares}. Its sign is"
        " wrong, or another joint moves the shaft"
    )
    remedy = (
        f"if this joint moves alone, give the {effort}, or position and velocity, a minus;"
        " otherwise log it while the other joints are held"
    )
    return Finding("error", "sign", None, text, remedy)


def _zero(balance: Balance | None, effort: str) -> Iterator[Finding]:
    """Find a pendulum that does not hang at position 0.

    If the effort is a voltage, only a position 0 near the top is reported, because gravity is a
    small part of the voltage besides friction and back-EMF.
    """
    names = "gravity", "gravity_aside"
    if (
        balance is None
        or max(abs(balance.t_values.get(name, 0.0)) for name in names) < _MIN_T_VALUE
    ):
        return
    along, aside = (balance.values.get(name, 0.0) for name in names)
    zero, pull = math.atan2(-aside, along), math.hypot(along, aside)
    # Over a small arc, gravity is nearly constant and looks the same as a constant load.
    if abs(balance.values.get("constant", 0.0)) > 0.5 * pull:
        return
    if pull > 2.0 * balance.residual and abs(zero) > (2.5 if effort == "voltage" else _MIN_TILT):
        hint = ", as if 0 were at the top" if abs(zero) > 2.5 else ""
        size = f"with up to {pull:.3g} {SIGNALS[effort]} of the {effort}"
        text = f"gravity pulls towards position {zero:.3g} rad and not 0{hint}, {size}"
        remedy = (
            f"write position=column{-zero:+.4g}:rad, so that the pendulum hangs at 0, or correct"
            " its sign"
        )
        yield Finding("warning", "zero", None, text, remedy)


@_needs("motion")
def _motion(facts: LogFacts) -> Iterator[Finding]:
    """Find a shaft that stands still, or that turns in one direction only."""
    signals, remedy = facts.log.signals, "leave position and velocity out if it was locked"
    speed = signals["velocity"] if "velocity" in signals else np.diff(signals["position"])
    if "stands" in facts.conditions:
        yield Finding(
            "info", "excitation", None, "the shaft stands still, as if it were locked", remedy
        )
    elif facts.effort and min(float(speed.max()), float(-speed.min())) < 0.05 * float(
        np.abs(speed).max()
    ):
        text = "the shaft turns in one direction only: friction looks the same as a constant load"
        yield Finding("info", "excitation", None, text, "add a log that reverses")


@_needs("voltage current torque")
def _two_constants(facts: LogFacts) -> Iterator[Finding]:
    """Compare the torque constant with the back-EMF constant.

    In SI units they are equal, except for losses and the convention for star or delta windings.
    """
    # In longer windows, the speed is less affected by the resolution of an encoder.
    balance = facts.winding and (voltage_balance(facts.log, 0.1) or facts.winding)
    if balance is None or balance.t_values.get("back_emf_constant", 0.0) < _MIN_T_VALUE:
        return
    back_emf = balance.values["back_emf_constant"]
    current, torque = facts.log.signals["current"], facts.log.signals["torque"]
    constant = float(current @ torque / max(current @ current, 1e-300))
    if constant <= 0.0:
        text = "torque and current have opposite signs"
        yield Finding("error", "sign", None, text, "give one of them a minus: torque=-column:N*m")
    elif abs(math.log(constant / back_emf)) > math.log(2.0):
        text = (
            f"torque/current is {constant:.3g} N*m/A and the back-EMF constant {back_emf:.3g}"
            " V*s/rad; they must be about "
        )
        text += f"equal: {explain_factor(constant / back_emf)}"
        yield Finding(
            "error", "unit", None, text, "correct the unit of torque, current, voltage or motion"
        )


@_needs("voltage current datasheet")
def _datasheet(facts: LogFacts) -> Iterator[Finding]:
    """Compare the resistance and the back-EMF constant with the datasheet."""
    motor, balance = facts.motor, facts.winding
    if motor is None or balance is None:
        return
    constant = motor.back_emf_constant * motor.gear_ratio
    for name, value in (("resistance", motor.resistance), ("back_emf_constant", constant)):
        if balance.t_values.get(name, 0.0) <= _MIN_T_VALUE or value <= 0.0:
            continue
        logged = balance.values[name]
        if abs(math.log(logged / value)) > math.log(2.0):
            unit = PARAMETERS[name].unit
            text = (
                f"the {name.replace('_', ' ')} would be {logged:.3g} {unit}, but the datasheet has"
                f" {value:.3g} {unit}: "
            )
            remedy = "correct the units of voltage, current and motion, or name the right motor"
            text += explain_factor(logged / value, name != "resistance")
            yield Finding("error", "unit", None, text, remedy)
