"""Diagrams of actuators, each drawn once for pages and pictures: torque over speed, Bode's of a current loop, steps."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from codrl_mj.actuators import (
    ActuatorModel,
    DCMotorActuator,
    Drive,
    Ideal,
    Inputs,
    Supply,
    TorqueSpeed,
    parameters_type,
)
from codrl_mj.sizing import (
    LoopDesign,
    CurrentLoopActuator,
    Response,
    abilities,
    closed_loop,
    design,
    open_loop,
    small_step_response,
)
from codrl_mj.sizing.abilities import diagram_limits, highest_current, torque_limits
from codrl_mj.sizing.loop import StepResponses
from codrl_mj.viz.pages.plots import Curve, Plot

TORQUE_SPEED = "speed of the output [rad/s]", "torque of the output [N·m]"
"""Axes of a torque-speed diagram."""
_SHOWN, _CLOSE = (0.0, 60.0), (19.5, 24.0)
"""Of a step out of saturation, what is shown, and what of it closely [ms]."""

Loops = Mapping[str, tuple[CurrentLoopActuator, float | None]]
"""Current loops by their names, with the mechanical step [s] of those that are no drives."""


def torque_speed_diagram(drive: Drive, numbers: Any = None, points: Any = None) -> Plot:
    """What a drive can do at the output of its gear, in all four quadrants, past friction: see `torque_limits`.

    Args:
        drive: whose voltage, `max_current`, gear and friction are drawn.
        numbers: `codrl_mj.catalogue.MotorNumbers`, for the continuous current; None where it is not
            known.
        points: shape (n, 2), operating points to lay over it: speed [rad/s] and torque [N*m] of the
            output.

    Raises:
        ValueError: the drive has no no-load speed to end the diagram at, or `points` have another
            shape.
    """
    can, lines = abilities(drive), diagram_limits(drive, numbers)
    points = np.empty((0, 2)) if points is None else np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(
            f"points: shape {points.shape}, must be (n, 2): speed [rad/s] and torque [N*m]"
        )
    width = 1.15 * max(can.no_load_speed, *np.abs(points[:, 0]), 0.0)
    height = 1.25 * max(min(can.stall_torque, 3.0 * can.peak_torque), *np.abs(points[:, 1]), 0.0)
    half = np.linspace(0.0, width, 400)[1:]
    speeds = np.concatenate(
        [-half[::-1], [-1e-9 * width, 1e-9 * width], half]
    )  # friction changes sign at standstill
    curves: list[Curve] = []
    peak = max(place for _, _, place in lines if place < 2)
    for label, current, place in lines:
        names, ends = (
            (f"{label}, lowest", f"{label}, highest"),
            torque_limits(drive, speeds, current),
        )
        curves += envelope(names, speeds, ends, place == peak, colour=place, dashed=place == 2)
    off = " (off the picture)" if can.stall_torque > height else ""
    stall = f"stall, {can.stall_torque:,.4g} N·m, {can.stall_current:,.4g} A{off}"
    free = f"no load, {can.no_load_speed:.4g} rad/s"
    curves += [
        Curve(
            stall, np.zeros(2), can.stall_torque * np.array([1.0, -1.0]), style="trail", colour=4
        ),
        Curve(
            free, can.no_load_speed * np.array([1.0, -1.0]), np.zeros(2), style="trail", colour=3
        ),
    ]
    if len(points):
        curves.append(
            Curve("operating points", points[:, 0], points[:, 1], style="trail", colour=5)
        )
    ratio = drive.motor.gear_ratio
    gear = f"behind a gear of {ratio:g}:1" if ratio != 1.0 else "without a gear"
    title = f"Torque and speed {gear}, friction taken off"
    corners = "braking", "driving", "driving", "braking"
    return Plot(title, *TORQUE_SPEED, tuple(curves), y_most=height, corners=corners)


def envelope(
    labels: tuple[str, str],
    speeds: np.ndarray,
    ends: tuple[np.ndarray, np.ndarray],
    filled: bool = True,
    **style: Any,
) -> list[Curve]:
    """The lowest and the highest torque [N*m] over speeds [rad/s], and what lies between."""
    lowest, highest = labels
    return [
        Curve(lowest, speeds, ends[0], **style),
        Curve(highest, speeds, ends[1], filled=filled, **style),
    ]


def episode_diagram(lines: Sequence[Any]) -> Plot | None:
    """The points of episodes in the plane of speed and torque, within what the motors (`episode._MotorLine`) can do."""
    curves: list[Curve] = []
    highest = 0.0
    own = [line for line in lines if not isinstance(line.actuator, Ideal)]
    if not own:
        return None
    for line in own:
        ratio = line.actuator.motor.gear_ratio if isinstance(line.actuator, Drive) else 1.0
        speed, torque = line.turning / ratio, line.actual * ratio
        free = no_load_speed(line.actuator)
        width = max(
            1.15 * free if np.isfinite(free) else 0.0, 1.1 * float(np.abs(speed).max()), 1e-6
        )
        most = max(float(np.abs(torque).max()), float(np.abs(line.desired).max()) * ratio, 1e-9)
        grid = np.linspace(-width, width, 401)
        ends = limits(line.actuator, grid)
        highest = max(
            highest, min(3.0 * most, 1.1 * float(np.abs(ends[1]).max()) if ends else most)
        )
        belongs: Any = {"shared": line.place, "tags": line.tags}
        if ends is not None:
            labels = f"{line.before}lowest possible", f"{line.before}highest possible"
            curves += envelope(labels, grid, ends, colour=0, dashed=True, **belongs)
        kept = slice(None, None, max(line.stride, len(speed) // 3000, 1))
        times = line.timestep * np.arange(len(speed))[kept]
        label = f"{line.before}episode"
        curves.append(
            Curve(label, speed[kept], torque[kept], style="trail", colour=1, times=times, **belongs)
        )
    title = "Torque and speed, within what the motor can do"
    return Plot(title, *TORQUE_SPEED, tuple(curves), y_most=highest)


def limits(actuator: Any, speeds: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Lowest and highest torque [N*m] that an actuator delivers at speeds [rad/s]; None where it has no such limits.

    The joint's friction, which the model has, is not taken off.
    """
    if isinstance(actuator, Drive):
        free = {
            f"motor.{name}": 0.0
            for name in ("coulomb_friction", "viscous_friction", "stribeck_friction")
        }
        return torque_limits(actuator.replaced(free), speeds, actuator.controller.max_current)
    if isinstance(actuator, TorqueSpeed):
        ends = (
            actuator.stall_torque * (side - speeds / actuator.no_load_speed) for side in (-1.0, 1.0)
        )
        most = actuator.max_torque if math.isfinite(actuator.max_torque) else actuator.stall_torque
        low, high = (np.clip(end, -most, most) for end in ends)
        return low, high
    if isinstance(actuator, DCMotorActuator) and actuator.voltage_limit is not None:
        motor, supply, most = (
            actuator.motor,
            actuator.supply or Supply(),
            actuator.controller.max_voltage,
        )
        limited = (
            (most, 0.0),
            (supply.voltage if math.isfinite(supply.voltage) else most, supply.resistance),
        )
        sides = []
        for side in (-1.0, 1.0):
            back_emf = side * motor.back_emf_constant * speeds
            currents = [highest_current(motor.resistance, *one, back_emf) for one in limited]
            sides.append(side * motor.torque_constant * np.minimum(*currents))
        return sides[0], sides[1]
    return None


def no_load_speed(actuator: Any) -> float:
    """Where the voltage makes no more torque [rad/s], before friction; infinite where nothing is known of it."""
    if isinstance(actuator, TorqueSpeed):
        return float(actuator.no_load_speed)
    if isinstance(actuator, Drive | DCMotorActuator) and actuator.voltage_limit is not None:
        constant = actuator.motor.back_emf_constant * getattr(actuator.motor, "gear_ratio", 1.0)
        return float(actuator.voltage_limit / constant) if constant > 0.0 else math.inf
    return math.inf


def bode_diagram(drive: Drive) -> list[Plot]:
    """Gain and phase of a drive's current loop, open and closed, with its margins and its bandwidth.

    Raises:
        ValueError: the loop is unstable.
    """
    one = design(drive)
    gain, phase = bode({"": (drive, None)}, {"": one})
    late = "a sample of delay" if one.delayed else "no delay"
    gains = f"kp = {one.kp:.4g} V/A, ki = {one.ki:,.5g} V/(A·s)"
    return [
        dataclasses.replace(
            gain, title=f"Current loop at {one.sample_rate / 1e3:g} kHz, {late}: {gains}"
        ),
        phase,
    ]


def bode(loops: Loops, designed: Mapping[str, LoopDesign]) -> list[Plot]:
    """Gain and phase of loops, open and closed; of one alone its margins and its bandwidth."""
    gains, phases = [], []
    for place, (name, loop) in enumerate(loops.items()):
        one = designed[name]
        lowest = np.nanmin([1e-3 * one.sample_rate, 0.02 * one.crossover])
        frequencies = np.geomspace(lowest, 0.49999 * one.sample_rate, 500)
        before = f"{name}: " if len(loops) > 1 else ""
        for label, function, dashed in (
            ("open loop", open_loop, True),
            ("closed loop", closed_loop, False),
        ):
            values = function(*loop)(np.exp(2j * math.pi * frequencies / one.sample_rate))
            more: dict[str, Any] = {
                "colour": place if len(loops) > 1 else int(not dashed),
                "dashed": dashed,
            }
            decibels, degrees = (
                20.0 * np.log10(np.abs(values)),
                np.degrees(np.unwrap(np.angle(values))),
            )
            gains.append(Curve(before + label, frequencies, decibels, **more))
            phases.append(Curve(before + label, frequencies, degrees, **more))
    if len(loops) == 1:
        gain, phase = _margins(one, frequencies[[0, -1]])
        gains, phases = gains + gain, phases + phase
    axis = "frequency [Hz]"
    return [
        Plot("Bode: gain", axis, "gain [dB]", tuple(gains), x_log=True),
        Plot("Bode: phase", axis, "phase [°]", tuple(phases), x_log=True),
    ]


def _margins(one: LoopDesign, ends: np.ndarray) -> tuple[list[Curve], list[Curve]]:
    """What a loop's gain and phase are judged by, between the ends of the axis [Hz]."""
    margin = 20.0 * math.log10(one.gain_margin)
    gains = [
        Curve("0 dB", ends, np.zeros(2), reference=True),
        _upright(f"gain margin {margin:.1f} dB", one.phase_crossover, -margin, 0.0),
    ]
    phases = [Curve("\N{MINUS SIGN}180°", ends, np.full(2, -180.0), reference=True)]
    if math.isfinite(one.bandwidth):
        label = f"bandwidth {one.bandwidth:.4g} Hz at \N{MINUS SIGN}3 dB"
        gains.append(
            Curve(label, np.array([one.bandwidth]), np.array([-3.0103]), style="dots", colour=1)
        )
    if math.isfinite(one.phase_margin):
        label = f"phase margin {one.phase_margin:.1f}° at {one.crossover:.4g} Hz"
        phases.append(_upright(label, one.crossover, -180.0, one.phase_margin - 180.0))
    return gains, phases


def _upright(label: str, x: float, low: float, high: float) -> Curve:
    return Curve(label, np.array([x, x * (1.0 + 1e-6)]), np.array([low, high]), colour=3)


def small_steps(loops: Loops) -> list[Plot]:
    """Small steps of the current, the shaft held, as shares of what is asked for; of one alone with its voltage."""
    curves = []
    for place, (name, loop) in enumerate(loops.items()):
        step = small_step_response(*loop)
        settled, asked = step.settling_time(), float(step.reference[-1])
        shown = max(int(3.0 * np.searchsorted(step.time, settled)), 20)
        step = Response(*(column[:shown] for column in step))
        time, share = 1e3 * step.time, step.current / asked
        if len(loops) > 1:
            curves.append(Curve(f"{name}: current", time, share, colour=place))
    title, scaled, voltage = "A small step of the current, the shaft held", None, []
    if len(loops) == 1:
        within = (
            f"within 2 % in {1e3 * settled:.3g} ms" if math.isfinite(settled) else "not settled"
        )
        torque = f"{loop[0].motor.torque_constant * asked:.3g} N·m at the rotor"
        curves = [Curve(f"current, of {asked:.3g} A, {torque}: {within}", time, share, colour=1)]
        scaled, voltage = ("current [A]", asked), [_voltages(loop[0], {"voltage": step})]
    curves.append(Curve("asked for", time, np.ones(len(time)), reference=True))
    return [
        Plot(title, "time [ms]", "share of what is asked for", tuple(curves), scaled=scaled),
        *voltage,
    ]


def recoveries(drive: Drive, steps: StepResponses) -> list[Plot]:
    """Current and voltage out of a demand that the voltage cannot meet, by kind of anti-windup; and the same close."""
    told = {}
    for kind, one in steps.recoveries.items():
        back = one.settling_time(0.05)
        took = f"{1e3 * back:.2g} ms" if math.isfinite(back) else "over 100 ms"
        told[f"{kind.replace('_', ' ')}: back in {took}"] = one
    at = f"at {steps.speed:.4g} rad/s of the rotor"
    title = f"{steps.unreachable:.3g} A, out of reach, then {steps.reachable:.3g} A, {at}"
    return [
        *_responses(drive, title, told, _SHOWN),
        *_responses(drive, "The same, close", told, _CLOSE),
    ]


def _responses(
    drive: Drive, title: str, responses: Mapping[str, Response], span: tuple[float, float]
) -> list[Plot]:
    """Current, with the rotor's torque, and voltage of responses to one reference, within a span [ms]."""
    shown = {}
    for label, one in responses.items():
        within = (1e3 * one.time >= span[0]) & (1e3 * one.time <= span[1])
        shown[label] = Response(*(column[within] for column in one))
    currents = [Curve(label, 1e3 * one.time, one.current) for label, one in shown.items()]
    last = list(shown.values())[-1]
    asked = Curve("asked for", 1e3 * last.time, last.reference, reference=True, style="step")
    torque = "torque of the rotor [N·m]", drive.motor.torque_constant
    return [
        Plot(title, "time [ms]", "current [A]", (*currents, asked), scaled=torque),
        _voltages(drive, {label.partition(":")[0]: one for label, one in shown.items()}),
    ]


def _voltages(loop: CurrentLoopActuator, responses: Mapping[str, Response]) -> Plot:
    """Voltage of responses, within a supply."""
    colour = None if len(responses) > 1 else 1
    curves = [
        Curve(label, 1e3 * one.time, one.voltage, style="step", colour=colour)
        for label, one in responses.items()
    ]
    if (limit := loop.voltage_limit) is not None:
        ends = curves[0].x[[0, -1]]
        curves += [
            Curve("supply", ends, np.full(2, side * limit), reference=True) for side in (1.0, -1.0)
        ]
    return Plot("Its voltage", "time [ms]", "voltage [V]", tuple(curves))


def held_step(steps: Mapping[str, tuple[ActuatorModel, float, float]]) -> Plot | None:
    """The torque after a step of what is asked for, the shaft held; None where nothing is of interest.

    By name: the actuator, the torque that is asked of it [N*m], the mechanical step [s].
    """
    curves = []
    for name, (actuator, asked, timestep) in steps.items():
        kind: Any = type(actuator)
        if not actuator.tracks or actuator.MOTION or not kind.State._fields or asked == 0.0:
            continue
        parameters, state = (
            parameters_type(kind)(*actuator.numbers),
            kind.State(*[0.0] * len(kind.State._fields)),
        )
        share = [0.0]
        for tick in range(100):
            inputs = Inputs(asked, 0.0, 0.0, tick * timestep, 0.0)
            state, torque, _ = kind.advance(parameters, timestep, state, inputs)
            share.append(torque / asked)
        time = timestep * np.arange(len(share))
        within = np.flatnonzero(np.abs(np.array(share) - share[-1]) > 0.02)
        shown = min(max(3 * (within[-1] + 1) if len(within) else 0, 20), len(share))
        label = f"{name}, at steps of {1e3 * timestep:.3g} ms"
        curves.append(Curve(label, time[:shown], np.array(share[:shown])))
    if not curves:
        return None
    longest = max((curve.x for curve in curves), key=lambda time: time[-1])
    curves.append(Curve("asked for", longest, np.ones(len(longest)), reference=True))
    return Plot(
        "A step of the torque, the shaft held",
        "time [s]",
        "share of what is asked for",
        tuple(curves),
    )
