"""What is wrong with a log before anything is fitted to it: a table of checks, each with what it needs of the log."""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

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
    find_resolution,
    is_supply_voltage,
    has_motion,
    find_obstacle,
    replace_signal,
    find_turn_jumps,
)
from codrl_mj.identify.parameters import PARAMETERS
from codrl_mj.identify.signal_checks import signal_findings

_DROPPED = 1.5  # median steps, from which on rows are missing
_MOST_LISTED = 10
_MOST = {"duty": 1.1, "voltage": 1e3, "bus": 1e3, "current": 1e3, "velocity": 2e4, "torque": 1e4}
"""In SI: a share with its rounding; beyond the largest motors of robots, and beyond 190,000 rpm."""
FACTORS = {
    "degrees for radians": 180.0 / math.pi,
    "rpm for rad/s": 30.0 / math.pi,
    "turns for radians": 2.0 * math.pi,
    "thousandths for units, as mA for A or ms for s": 1000.0,
    "hundredths for units, as N*cm for N*m or percent for shares": 100.0,
    "kgf*cm for N*m": 10.197,
    "degrees for turns": 360.0,
    "rpm for turn/s": 60.0,
}
"""What a factor between two numbers that should be equal may tell, one for the other or the other way round."""
_RESISTANCES = (
    5e-3,
    1e4,
)  # of motors on a bench [ohm]: at 5 V the least would draw 1 kA; micromotors have some hundreds
_CERTAIN = 10.0  # coefficient over its standard error
_TURNED = 2.0 / 3.0  # of the residual, that a sign must leave at most to be the right one
_DROWNED = 0.1  # noise over the motion, beyond which no error of speeds is claimed
_TILTED = 0.03  # rad, by which a pendulum hangs beside position 0


class LogFacts(NamedTuple):
    """A log under examination, beside a datasheet's `GearMotor` and on a rig, where given."""

    log: Log
    motor: Any
    rig: str | None
    effort: str  # what drives it, the nearest to the shaft that it has
    holds: set[str]  # words of `CHECKS`: signals, and what is known of them
    winding: Balance | None  # R, L and kE by the voltage; None where it does not change


CHECKS: list[tuple[set[str], Callable[[LogFacts], Iterator[Finding]]]] = []
"""What a check needs of a log, and what finds and words what it finds; in this order."""


def _needs(words: str) -> Callable[[Any], Any]:
    def add(found: Any) -> Any:
        CHECKS.append(({*words.split()}, found))
        return found

    return add


def check(log: Log, motor: Any = None, rig: str | None = None) -> list[Finding]:
    """What is noteworthy about a log, errors first; beside a datasheet's `GearMotor` and on a rig, where given."""
    effort = next((name for name in ("torque", "current", "voltage") if log.has(name)), "")
    holds = {*log.signals, *(["effort"] if effort else []), *(["datasheet"] if motor else [])}
    if log.has("position") or log.has("velocity"):
        holds |= {"motion", "moves" if has_motion(log) else "stands"}
    holds |= {"hangs"} if rig in (None, "pendulum") else set()
    winding = voltage_balance(log) if log.has("voltage", "current") else None
    seen = LogFacts(log, motor, rig, effort, holds, winding)
    findings = [
        *log.findings,
        *(one for needs, found in CHECKS if needs <= holds for one in found(seen)),
    ]
    order = ("error", "warning", "info")
    return sorted(findings, key=lambda one: order.index(one.severity))


def explain_factor(ratio: float, angle: bool = True) -> str:
    """What a ratio, or its inverse, could be: all confusions within 8 %, else a scale or a gear."""
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
def _obstacle(seen: LogFacts) -> Iterator[Finding]:
    """Find what a fit of this log alone would refuse."""
    if found := find_obstacle([seen.log]):
        yield found


@_needs("")
def _times(seen: LogFacts) -> Iterator[Finding]:
    """Gaps, dropped rows, jitter, and stamps in another unit."""
    log, usual, rows = seen.log, seen.log.step, seen.log.row_numbers
    steps = np.diff(log.time)
    gaps = np.flatnonzero(steps > GAP_STEPS * usual)
    for place in gaps[:_MOST_LISTED]:
        text = (
            f"a gap of {steps[place]:.4g} s after {log.time[place]:.4g} s,"
            f" {steps[place] / usual:.0f} usual steps"
        )
        yield Finding(
            "warning", "gap", int(rows[place + 1]), text, "nothing is simulated across it"
        )
    if gaps.size > _MOST_LISTED:
        yield Finding(
            "warning", "gap", None, f"{gaps.size - _MOST_LISTED} more gaps", "see the first ones"
        )
    dropped = np.flatnonzero((steps > _DROPPED * usual) & (steps <= GAP_STEPS * usual))
    if dropped.size:
        missing = int(np.sum(np.round(steps[dropped] / usual) - 1.0))
        share = missing / (len(log.time) + missing)
        text = (
            f"{missing} rows missing ({share:.2g} of all) in {dropped.size} places, the first one"
            " here"
        )
        remedy = (
            "keep the stamps: they are gone by; as if the rows were uniform, the fit would be wrong"
        )
        severity = "warning" if share > 0.01 else "info"
        yield Finding(severity, "dropped rows", int(rows[dropped[0] + 1]), text, remedy)
    regular = steps[steps <= _DROPPED * usual]
    jitter = float(np.std(regular)) / usual
    if jitter > 0.02:
        worst = int(np.argmax(np.where(steps <= _DROPPED * usual, np.abs(steps - usual), 0.0)))
        text = (
            f"steps of {regular.min():.3g} to {regular.max():.3g} s about {usual:.3g} s,"
            f" {jitter:.0%} of it"
        )
        remedy = "take each stamp when the values are read"
        yield Finding(
            "warning" if jitter > 0.3 else "info", "jitter", int(rows[worst + 1]), text, remedy
        )
    if not 2e-6 <= usual <= 0.5:
        text = f"a row every {usual:.3g} s is unusual: is the time in another unit?"
        yield Finding("error", "unit", None, text, "write time=column:ms, or us, or ns")


@_needs("")
def _signals(seen: LogFacts) -> Iterator[Finding]:
    """Each signal by itself."""
    yield from signal_findings(seen.log)


@_needs("position")
def _wrapped(seen: LogFacts) -> Iterator[Finding]:
    """A position that jumps by a turn."""
    jumps = find_turn_jumps(seen.log.signals["position"], 2.0 * math.pi)
    if jumps.size:
        text = f"the position jumps by a turn, {jumps.size} times, first here"
        remedy = "write position=unwrap(column, 2*pi):rad, or unwrap(column, 360):deg"
        yield Finding("error", "wrapped", int(seen.log.row_numbers[jumps[0] + 1]), text, remedy)


@_needs("")
def _sizes(seen: LogFacts) -> Iterator[Finding]:
    """Values that no bench has: more voltage than the supply has, too, and what looks like a duty."""
    for signal in _MOST.keys() & seen.log.signals.keys():
        largest = float(np.quantile(np.abs(seen.log.signals[signal]), 0.99))  # not an outlier
        unit = SIGNALS[signal] or "of 1"
        if largest > _MOST[signal]:
            text = (
                f"the {signal} is up to {largest:.4g} {unit}, must be at most {_MOST[signal]:g}"
                f" {unit} on a bench"
            )
            other = "percent" if signal == "duty" else f"m{unit}"
            yield Finding(
                "error", "unit", None, text, f"correct its unit, such as {signal}=column:{other}"
            )
    if not seen.log.has("voltage"):
        return
    log, voltage = seen.log, np.abs(seen.log.signals["voltage"])
    others = [log.signals[one] for one in ("current", "torque", "velocity") if log.has(one)]
    if log.has("position"):  # over many rows, in which an encoder's flicker is nothing
        rows, position = max(len(log.time) // 20, 1), log.signals["position"]
        others.append(position[rows:] - position[:-rows])
    if is_supply_voltage(log.signals["voltage"], others):
        text = (
            f"the voltage stays near {np.median(voltage):.3g} V while the motor goes both ways: it"
            " is the supply's"
        )
        yield Finding(
            "error",
            "voltage",
            None,
            text,
            "write bus=column:V, and log the motor's own voltage or its duty",
        )
    if log.has("bus"):
        excess = voltage / np.maximum(np.abs(log.signals["bus"]), 1e-9)
        row = int(np.argmax(excess))
        if excess[row] >= 1.1:
            text = f"the voltage is up to {excess[row]:.3g} times that of the supply"
            remedy = "correct the scale of the duty, or of the bus"
            yield Finding("error", "unit", int(log.row_numbers[row]), text, remedy)
    elif seen.motor is None and (0.0 < voltage.max() <= 1.0 or voltage.max() > 100.0):
        of = "a duty" if voltage.max() <= 1.0 else "of a duty in percent, or in mV"
        text = f"the voltage is at most {voltage.max():.3g} V: is it {of}?"
        remedy = (
            "if so, write voltage=duty*24:V, with a duty from -1 to 1 and the volts of the supply"
        )
        yield Finding("warning", "unit", None, text, remedy)


@_needs("position")
def _degrees(seen: LogFacts) -> Iterator[Finding]:
    """A position in degrees: gravity pulls as at a fraction of it, or its encoder divides 360 and not 2 pi."""
    log, effort, remedy = seen.log, seen.effort, "write position=column:deg"
    if {"effort", "moves", "hangs"} <= seen.holds:
        turned = replace_signal(log, "position", np.deg2rad(log.signals["position"]))
        now, then = (torque_balance(one, effort, aside=True) for one in (log, turned))
        pulls = then is not None and then.certainty.get("gravity", 0.0) > _CERTAIN
        if now and then and pulls and then.residual < 0.5 * now.residual and now.unexplained > 0.1:
            text = (
                f"gravity pulls as if the position were in degrees: so {then.unexplained:.0%} of"
                f" the {effort} are "
            )
            text += f"not explained, of radians {now.unexplained:.0%}"
            yield Finding("error", "unit", None, text, remedy)
            return
    step = log.resolution.get("position", 0.0) or find_resolution(log.signals["position"])
    if step > 0.0 and 8.0 < (turns := 360.0 / step) < 1e5:
        count, of_radians = round(turns), 2.0 * math.pi / step
        if abs(turns - count) < 1e-6 * turns and abs(of_radians - round(of_radians)) > 1e-3:
            text = (
                f"the position's steps of {step:.4g} are 1/{count} of 360, not of 2 pi: is it in"
                " degrees?"
            )
            decimal = round(step / 10.0 ** math.floor(math.log10(step)), 5) in (1.0, 2.0, 2.5, 5.0)
            encoder = not decimal and (count % 100 == 0 or count & (count - 1) == 0)
            yield Finding("error" if encoder else "warning", "unit", None, text, remedy)


@_needs("position velocity moves")
def _velocity(seen: LogFacts) -> Iterator[Finding]:
    """The velocity against the differentiated position."""
    found = velocity_lag(seen.log)
    if found is None:
        return
    clear = found.noise < _DROWNED
    if found.unexplained > 0.5:
        text = (
            f"velocity and differentiated position have nothing in common ({found.unexplained:.0%}"
            " is left over)"
        )
        if clear:
            yield Finding(
                "error", "velocity", None, text, "check both columns; leave the velocity out"
            )
        return
    if clear and found.gain < 0.0:
        text = "the velocity falls where the position grows"
        yield Finding(
            "error", "sign", None, text, "give one of them a minus: velocity=-column:unit"
        )
    # noise of the one takes from its factor, of the other it adds to it: the true one is between
    # both regressions
    ends = [math.log(abs(found.gain)), math.log(abs(found.gain) / (1.0 - found.unexplained**2))]
    if clear and (min(ends) > 0.1 or max(ends) < -0.1):
        text = (
            f"the velocity is {abs(found.gain):.4g} times what the position says:"
            f" {explain_factor(found.gain)}"
        )
        yield Finding("error", "unit", None, text, "correct the unit of velocity, position or time")
    rows = abs(found.lag) / seen.log.step
    if (rows > 0.75 and found.improvement < 0.7) or (rows > 2.0 and found.improvement < 0.85):
        late = "after" if found.lag > 0.0 else "before"
        text = (
            f"the velocity comes {1e3 * abs(found.lag):.3g} ms {late} the differentiated position"
            f" ({rows:.2g} rows)"
        )
        remedy = "leave the velocity out, so that the position alone is fitted, or fit its delay"
        yield Finding("warning", "lag", None, text, remedy)


@_needs("voltage current")
def _electrical(seen: LogFacts) -> Iterator[Finding]:
    """Signs and certainty of R, L and kE."""
    balance = seen.winding
    if balance is None:
        text = "voltage or current do not change, or there are too few rows in a row"
        yield Finding(
            "error",
            "excitation",
            None,
            text,
            "log while the voltage changes; see codrl-mj identify plan",
        )
        return
    values, certain = balance.values, balance.certainty
    if certain["resistance"] < -_CERTAIN:
        text = (
            f"the resistance would be {values['resistance']:.3g} ohm: the current flows against the"
            " voltage"
        )
        yield Finding("error", "sign", None, text, "give one of them a minus: current=-column:A")
    elif (
        certain["resistance"] > _CERTAIN
        and not _RESISTANCES[0] <= values["resistance"] <= _RESISTANCES[1]
    ):
        text = (
            f"the resistance would be {values['resistance']:.3g} ohm, outside {_RESISTANCES[0]:g}"
            " to 1e4 ohm"
        )
        remedy = "correct the unit of voltage or current: current=column:mA if it is in mA"
        yield Finding("error", "unit", None, text, remedy)
    elif certain.get("back_emf_constant", 0.0) < -_CERTAIN:
        text = (
            f"the back-EMF constant would be {values['back_emf_constant']:.3g} V*s/rad: the motor"
            " turns against it"
        )
        remedy = "give position and velocity a minus, or voltage and current"
        yield Finding("error", "sign", None, text, remedy)
    for name, what in (
        ("inductance", "quickly: a PRBS"),
        ("back_emf_constant", "speed: a slow sine"),
    ):
        if name in values and abs(certain[name]) < _CERTAIN:
            text = (
                f"the {name.replace('_', ' ')} hardly shows: it is {abs(certain[name]):.2g}"
                " standard errors"
            )
            yield Finding(
                "info",
                "excitation",
                None,
                text,
                f"add a log that changes {what}, or give it by --known",
            )
    if balance.unexplained > 0.3:
        text = (
            f"R*i + L*di/dt + kE*speed leaves {balance.unexplained:.0%} of the voltage unexplained"
        )
        remedy = (
            "check that the voltage is that of the terminals, and that rows are as frequent as it"
            " changes"
        )
        yield Finding("warning", "voltage", None, text, remedy)


@_needs("voltage current")
def _delay(seen: LogFacts) -> Iterator[Finding]:
    """The current against the voltage."""
    log, found = seen.log, effort_lag(seen.log, "voltage")
    if found is None or found.unexplained > 0.3:
        return
    rows = found.lag / log.step
    if abs(rows) >= 0.7 and found.improvement < 0.55:
        late = "after" if rows > 0.0 else "before"
        text = (
            f"the current comes {abs(rows):.2g} rows ({1e3 * abs(found.lag):.3g} ms) {late} the"
            " voltage"
        )
        yield Finding(
            "warning",
            "lag",
            None,
            text,
            "fit with a scan over delays, or shift a column of the log",
        )
    elif -0.8 < rows < -0.2 and found.improvement < 0.8:
        declared = (
            "declared as the mean to the next row" if log.mean_voltage else "held to the next row"
        )
        text = (
            f"the voltage fits better about half a row earlier than {declared}: it seems to be read"
            " at the row"
        )
        remedy = "log the mean of the voltage, or rows as frequent as it changes"
        if log.mean_voltage:
            remedy = "write voltage=column:V without mean(); or log the mean"
        yield Finding("warning" if log.mean_voltage else "info", "voltage", None, text, remedy)


@_needs("voltage current")
def _sag(seen: LogFacts) -> Iterator[Finding]:
    """A supply that gives way, where the share of its voltage changes; at one share it looks as the winding does."""
    balance, share = seen.winding, np.abs(seen.log.signals["voltage"])
    sagging = (
        voltage_balance(seen.log, sag=True)
        if float(np.std(share)) > 0.1 * float(share.max())
        else None
    )
    if balance is None or sagging is None or sagging.residual > 0.96 * balance.residual:
        return
    supply, winding = sagging.values["supply_resistance"], sagging.values["resistance"]
    if sagging.certainty["supply_resistance"] > _CERTAIN and supply > 0.03 * winding > 0.0:
        text = f"the voltage sags as behind {supply:.2g} ohm, beside a winding of {winding:.2g} ohm"
        remedy = "log the voltage of the supply, and write voltage=duty*bus:V"
        yield Finding("warning", "sag", None, text, remedy)


@_needs("effort moves")
def _mechanical(seen: LogFacts) -> Iterator[Finding]:
    """Signs of inertia and gravity; whether the motion follows from the torque."""
    log, effort, rig = seen.log, seen.effort, seen.rig
    # where it shakes, shorter windows show more of the inertia
    balances = [
        one
        for seconds in (0.3, 0.03)
        if (one := torque_balance(log, effort, seconds, rig=rig)) is not None
    ]
    if not balances:
        return
    balance, certain = balances[0], balances[0].certainty
    both = [one.certainty.get("inertia", 0.0) for one in balances]
    heavy = max(both, key=abs) if max(both) < 3.0 else 0.0
    wrong = heavy < -_CERTAIN or (certain.get("gravity", 0.0) < -_CERTAIN and heavy < -3.0)
    if wrong and (told := _told_sign(log, effort, rig)):
        remedy = f"give the {effort}, or position and velocity, a minus"
        yield Finding(
            "error", "sign", None, f"the {effort} accelerates the wrong way: {told}", remedy
        )
    elif {"position", "hangs"} <= seen.holds:
        yield from _zero(torque_balance(log, effort, aside=True), effort)
    large = 0.08 * float(
        np.std(log.signals[effort])
    )  # else it is what fast changes leave of rounding
    if effort == "torque" and balance.unexplained > 0.25 and balance.residual > large:
        text = (
            f"the motion leaves {balance.unexplained:.0%} of the torque unexplained (mean over"
            " 0.3 s)"
        )
        lag = effort_lag(log, effort)
        if lag is not None and abs(lag.lag) > log.step and lag.improvement < 0.9:
            text += f"; {lag.unexplained:.0%} if the motion came {1e3 * lag.lag:.3g} ms later"
        remedy = (
            "something else moves it, or the columns are not of one time: trust this log less than"
            " others"
        )
        yield Finding("warning", "torque", None, text, remedy)


def _told_sign(log: Log, effort: str, rig: str | None) -> str:
    """How much better a body with friction explains the effort with a minus; empty where it does not.

    The other check, by standard errors, is fooled where friction that holds, or a controller, makes
    what it sees.
    """
    for seconds in (0.3, 0.03):
        now, turned = (
            torque_balance(log, effort, seconds, rig=rig, sign=sign) for sign in (1.0, -1.0)
        )
        if now is None or turned is None or now.unexplained < 0.03:
            continue  # as it is nothing is amiss
        if turned.residual < _TURNED * now.residual:
            shares = (
                f"{now.unexplained:.1%} of it unexplained, with a minus {turned.unexplained:.2%}"
            )
            return f"inertia and friction leave {shares}"
    return ""


def _zero(balance: Balance | None, effort: str) -> Iterator[Finding]:
    """Where a pendulum hangs; beside 0 that is not told of a voltage, of which friction and back-EMF leave little."""
    names = "gravity", "gravity_aside"
    if balance is None or max(abs(balance.certainty.get(name, 0.0)) for name in names) < _CERTAIN:
        return
    along, aside = (balance.values.get(name, 0.0) for name in names)
    zero, pull = math.atan2(-aside, along), math.hypot(along, aside)
    if abs(balance.values.get("constant", 0.0)) > 0.5 * pull:
        return  # over a small arc a pull and a constant load against it are as good as nothing
    if pull > 2.0 * balance.residual and abs(zero) > (2.5 if effort == "voltage" else _TILTED):
        where = ", as if 0 were at the top" if abs(zero) > 2.5 else ""
        most = f"with up to {pull:.3g} {SIGNALS[effort]} of the {effort}"
        text = f"gravity pulls towards position {zero:.3g} rad and not 0{where}, {most}"
        remedy = (
            f"write position=column{-zero:+.4g}:rad, so that it hangs at 0; or its sign is wrong"
        )
        yield Finding("warning", "zero", None, text, remedy)


@_needs("motion")
def _motion(seen: LogFacts) -> Iterator[Finding]:
    """Whether it moves back and forth."""
    signals, remedy = seen.log.signals, "leave position and velocity out if it is"
    speed = signals["velocity"] if "velocity" in signals else np.diff(signals["position"])
    if "stands" in seen.holds:
        yield Finding(
            "info", "excitation", None, "the shaft stands still, as if it were locked", remedy
        )
    elif seen.effort and min(float(speed.max()), float(-speed.min())) < 0.05 * float(
        np.abs(speed).max()
    ):
        text = "the shaft turns one way only: friction cannot be told from a constant load"
        yield Finding("info", "excitation", None, text, "add a log that reverses")


@_needs("voltage current torque")
def _two_constants(seen: LogFacts) -> Iterator[Finding]:
    """The torque constant against the back-EMF constant, which in SI are equal but for losses and star or delta."""
    # the steps of an encoder take less from the speed of longer windows
    balance = seen.winding and (voltage_balance(seen.log, 0.1) or seen.winding)
    if balance is None or balance.certainty.get("back_emf_constant", 0.0) < _CERTAIN:
        return
    back_emf = balance.values["back_emf_constant"]
    current, torque = seen.log.signals["current"], seen.log.signals["torque"]
    constant = float(current @ torque / max(current @ current, 1e-300))
    if constant <= 0.0:
        text = "torque and current are of opposite signs"
        yield Finding("error", "sign", None, text, "give one of them a minus: torque=-column:N*m")
    elif abs(math.log(constant / back_emf)) > math.log(2.0):
        text = (
            f"torque/current is {constant:.3g} N*m/A and the back-EMF constant {back_emf:.3g}"
            " V*s/rad, must be about "
        )
        text += f"equal: {explain_factor(constant / back_emf)}"
        yield Finding(
            "error", "unit", None, text, "correct the unit of torque, current, voltage or motion"
        )


@_needs("voltage current datasheet")
def _datasheet(seen: LogFacts) -> Iterator[Finding]:
    """Resistance and back-EMF constant against what is printed."""
    motor, balance = seen.motor, seen.winding
    constant = motor.back_emf_constant * motor.gear_ratio
    for name, value in (("resistance", motor.resistance), ("back_emf_constant", constant)):
        if balance is None or balance.certainty.get(name, 0.0) <= _CERTAIN or value <= 0.0:
            continue
        found = balance.values[name]
        if abs(math.log(found / value)) > math.log(2.0):
            unit = PARAMETERS[name].unit
            text = (
                f"the {name.replace('_', ' ')} would be {found:.3g} {unit}, the datasheet says"
                f" {value:.3g} {unit}: "
            )
            remedy = "correct the units of voltage, current and motion, or name the right motor"
            text += explain_factor(found / value, name != "resistance")
            yield Finding("error", "unit", None, text, remedy)
