"""Diagrams of actuators for pages and pictures: torque-speed curves, Bode plots, step responses."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike

from codrl_mj.actuators import (
    ActuatorModel,
    DCMotorActuator,
    Drive,
    Geared,
    Ideal,
    Inputs,
    PwmServo,
    Supply,
    TorqueSpeed,
    parameters_type,
)
from codrl_mj.actuators.model import FamilyTuple
from codrl_mj.catalogue import MotorParameters
from codrl_mj.evaluation.evaluate import MotorTrace
from codrl_mj.plots import Curve, CurveOwner, CurveStyle, Plot
from codrl_mj.sizing import (
    CurrentLoopActuator,
    LoopAnalysis,
    Response,
    analyze_loop,
    closed_loop,
    drive_limits,
    open_loop,
    small_step_response,
)
from codrl_mj.sizing.limits import diagram_limits, highest_current, torque_limits
from codrl_mj.sizing.loop import StepResponses

TORQUE_SPEED = "speed of the output [rad/s]", "torque of the output [N·m]"
"""Axes of a torque-speed diagram."""
_RECOVERY_SPAN, _CLOSE_UP_SPAN = (0.0, 60.0), (19.5, 24.0)
"""Time spans of a step out of saturation [ms]: the whole step, and a close-up."""

Loops = Mapping[str, tuple[CurrentLoopActuator, float | None]]
"""Name of a current loop -> the loop, and the mechanical step [s] if it is not a drive's."""


@dataclasses.dataclass(frozen=True)
class MotorSeries(MotorTrace):
    """Signals of one motor of one run, with the style of their curves."""

    label_prefix: str
    """Prefix of the curves' labels."""
    color_index: int | None
    """Index of the motor among those of all runs, for its color; None for a single motor."""
    tags: tuple[str, ...]
    """Owners of the curves: the run and the motor."""
    stride: int
    """Number of integration steps per drawn point."""

    @property
    def turning(self) -> np.ndarray:
        """Velocity of the shaft at the end of each integration step [rad/s]."""
        return self.speed[1:] / self.actuator.arm_radius

    def has(self, *names: str) -> bool:
        """Return True if the motor's family has these signals."""
        return not isinstance(self.actuator, Ideal) and set(names) <= self.signals.keys()

    def curve(
        self, label: str, values: np.ndarray, color: int, held: bool = True, dashed: bool = False
    ) -> Curve:
        """Return a curve over the integration steps.

        Values that are `held` apply from the start of each step, others at its end.
        """
        selection = slice(None, None, self.stride)
        values = np.asarray(values, dtype=float)
        time = self.timestep * (np.arange(len(values)) + (not held))
        # A held value needs the end of the last step too, to be drawn over its whole length.
        if held:
            time = np.append(time[selection], time[-1] + self.timestep)
            values = np.append(values[selection], values[-1])
        else:
            time, values = time[selection], values[selection]
        return Curve(
            self.label_prefix + label,
            time,
            values,
            style="step" if held else "line",
            colour=color,
            shared=self.color_index,
            dashed=dashed,
            tags=self.tags,
        )


def torque_speed_diagram(
    drive: Drive, numbers: MotorParameters | None = None, points: ArrayLike | None = None
) -> Plot:
    """Return the torque that a drive can deliver at its output in all quadrants, minus friction.

    See `torque_limits`.

    Args:
        drive: drive whose voltage, `max_current`, gear and friction are drawn.
        numbers: numbers of the motor, for the continuous current; None if
            it is unknown.
        points: operating points to draw too, shape (n, 2): speed [rad/s] and torque [N*m] of the
            output.

    Raises:
        ValueError: the drive has no finite no-load speed, or `points` have another shape.
    """
    limits, lines = drive_limits(drive), diagram_limits(drive, numbers)
    points = np.empty((0, 2)) if points is None else np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(
            f"points: shape {points.shape}, must be (n, 2): speed [rad/s] and torque [N*m]"
        )
    width = 1.15 * max(limits.no_load_speed, *np.abs(points[:, 0]), 0.0)
    height = 1.25 * max(
        min(limits.stall_torque, 3.0 * limits.peak_torque),
        *np.abs(points[:, 1]),
        0.0,
    )
    positive_speeds = np.linspace(0.0, width, 400)[1:]
    # Friction changes its sign at standstill: a point on either side draws the jump.
    speeds = np.concatenate(
        [-positive_speeds[::-1], [-1e-9 * width, 1e-9 * width], positive_speeds]
    )
    curves: list[Curve] = []
    peak = max(color_index for _, _, color_index in lines if color_index < 2)
    for label, current, color_index in lines:
        names = (f"{label}, lowest", f"{label}, highest")
        torques = torque_limits(drive, speeds, current)
        curves += envelope(
            names, speeds, torques, color_index == peak, colour=color_index, dashed=color_index == 2
        )
    remark = " (outside the plot)" if limits.stall_torque > height else ""
    stall = f"stall, {limits.stall_torque:,.4g} N·m, {limits.stall_current:,.4g} A{remark}"
    no_load = f"no load, {limits.no_load_speed:.4g} rad/s"
    curves += [
        Curve(
            stall,
            np.zeros(2),
            limits.stall_torque * np.array([1.0, -1.0]),
            style="trail",
            colour=4,
        ),
        Curve(
            no_load,
            limits.no_load_speed * np.array([1.0, -1.0]),
            np.zeros(2),
            style="trail",
            colour=3,
        ),
    ]
    if len(points):
        curves.append(
            Curve("operating points", points[:, 0], points[:, 1], style="trail", colour=5)
        )
    ratio = drive.motor.gear_ratio
    gear = f"behind a gear of {ratio:g}:1" if ratio != 1.0 else "without a gear"
    title = f"Torque and speed {gear}, friction subtracted"
    corners = "braking", "driving", "driving", "braking"
    return Plot(title, *TORQUE_SPEED, tuple(curves), y_limit=height, corners=corners)


def envelope(
    labels: tuple[str, str],
    speeds: np.ndarray,
    torques: tuple[np.ndarray, np.ndarray],
    filled: bool = True,
    **style: Unpack[CurveStyle],
) -> list[Curve]:
    """Return the curves of the lowest and highest torque [N*m] over speeds [rad/s]."""
    lowest, highest = labels
    return [
        Curve(lowest, speeds, torques[0], **style),
        Curve(highest, speeds, torques[1], filled=filled, **style),
    ]


def episode_diagram(lines: Sequence[MotorSeries]) -> Plot | None:
    """Return the torque-speed points of episodes within the limits of their motors."""
    curves: list[Curve] = []
    highest = 0.0
    motor_lines = [line for line in lines if not isinstance(line.actuator, Ideal)]
    if not motor_lines:
        return None
    for line in motor_lines:
        ratio = line.actuator.motor.gear_ratio if isinstance(line.actuator, Geared) else 1.0
        speed, torque = line.turning / ratio, line.actual * ratio
        no_load = no_load_speed(line.actuator)
        width = max(
            1.15 * no_load if np.isfinite(no_load) else 0.0, 1.1 * float(np.abs(speed).max()), 1e-6
        )
        max_torque = max(
            float(np.abs(torque).max()), float(np.abs(line.desired).max()) * ratio, 1e-9
        )
        grid = np.linspace(-width, width, 401)
        torques = torque_range(line.actuator, grid)
        highest = max(
            highest,
            min(3.0 * max_torque, 1.1 * float(np.abs(torques[1]).max()) if torques else max_torque),
        )
        owner: CurveOwner = {"shared": line.color_index, "tags": line.tags}
        if torques is not None:
            labels = f"{line.label_prefix}lowest possible", f"{line.label_prefix}highest possible"
            curves += envelope(labels, grid, torques, colour=0, dashed=True, **owner)
        selection = slice(None, None, max(line.stride, len(speed) // 3000, 1))
        times = line.timestep * np.arange(len(speed))[selection]
        label = f"{line.label_prefix}episode"
        curves.append(
            Curve(
                label,
                speed[selection],
                torque[selection],
                style="trail",
                colour=1,
                times=times,
                **owner,
            )
        )
    title = "Torque and speed, within the limits of the motor"
    return Plot(title, *TORQUE_SPEED, tuple(curves), y_limit=highest)


def torque_range(
    actuator: ActuatorModel, speeds: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lowest and highest torque [N*m] of an actuator at speeds [rad/s], or None.

    None means that there are no such limits. The friction of the joint is part of the model and is
    not subtracted.
    """
    if isinstance(actuator, PwmServo):
        # At the largest duty cycle d the motor gets d*(V - d*r*i) of the supply.
        duty = actuator.loop.max_duty
        supply = Supply(duty * actuator.voltage_limit, duty * duty * actuator.supply_resistance)
        actuator = Drive(actuator.motor, supply=supply)
    if isinstance(actuator, Drive):
        no_friction: dict[str, float | None] = {
            f"motor.{name}": 0.0
            for name in ("coulomb_friction", "viscous_friction", "stribeck_friction")
        }
        no_friction["friction"] = None
        return torque_limits(
            actuator.replaced(no_friction), speeds, actuator.controller.max_current
        )
    if isinstance(actuator, TorqueSpeed):
        lines = (
            actuator.stall_torque * (side - speeds / actuator.no_load_speed) for side in (-1.0, 1.0)
        )
        max_value = (
            actuator.max_torque if math.isfinite(actuator.max_torque) else actuator.stall_torque
        )
        low, high = (np.clip(end, -max_value, max_value) for end in lines)
        return low, high
    if isinstance(actuator, DCMotorActuator) and actuator.voltage_limit is not None:
        motor = actuator.motor
        supply = actuator.supply or Supply()
        max_value = actuator.controller.max_voltage
        # The controller's limit applies to the motor's voltage. The supply's limit includes the
        # voltage drop over its resistance.
        limited = (
            (max_value, 0.0),
            (supply.voltage if math.isfinite(supply.voltage) else max_value, supply.resistance),
        )
        sides = []
        for side in (-1.0, 1.0):
            back_emf = side * motor.back_emf_constant * speeds
            currents = [
                highest_current(motor.resistance, *supply_limit, back_emf)
                for supply_limit in limited
            ]
            sides.append(side * motor.torque_constant * np.minimum(*currents))
        return sides[0], sides[1]
    return None


def no_load_speed(actuator: ActuatorModel) -> float:
    """Return the speed without torque, before friction [rad/s]; infinite if it is unknown."""
    if isinstance(actuator, TorqueSpeed):
        return float(actuator.no_load_speed)
    if isinstance(actuator, Geared | DCMotorActuator) and actuator.voltage_limit is not None:
        constant = actuator.motor.back_emf_constant * getattr(actuator.motor, "gear_ratio", 1.0)
        return float(actuator.voltage_limit / constant) if constant > 0.0 else math.inf
    return math.inf


def bode_diagram(drive: Drive) -> list[Plot]:
    """Return gain and phase of a drive's current loop, open and closed, with margins and bandwidth.

    Raises:
        ValueError: the loop is unstable.
    """
    loop_design = analyze_loop(drive)
    gain, phase = bode_plots({"": (drive, None)}, {"": loop_design})
    delay_text = "a sample of delay" if loop_design.delayed else "no delay"
    gains = f"kp = {loop_design.kp:.4g} V/A, ki = {loop_design.ki:,.5g} V/(A·s)"
    return [
        dataclasses.replace(
            gain,
            title=f"Current loop at {loop_design.sample_rate / 1e3:g} kHz, {delay_text}: {gains}",
        ),
        phase,
    ]


def bode_plots(loops: Loops, designed: Mapping[str, LoopAnalysis]) -> list[Plot]:
    """Return gain and phase of loops, open and closed; for a single loop with its margins."""
    gains, phases = [], []
    for index, (name, loop) in enumerate(loops.items()):
        loop_design = designed[name]
        lowest = np.nanmin([1e-3 * loop_design.sample_rate, 0.02 * loop_design.crossover])
        # The phase of a sampled loop jumps at half the sample rate, so the curves end just below
        # it.
        frequencies = np.geomspace(lowest, 0.49999 * loop_design.sample_rate, 500)
        prefix = f"{name}: " if len(loops) > 1 else ""
        for label, function, dashed in (
            ("open loop", open_loop, True),
            ("closed loop", closed_loop, False),
        ):
            values = function(*loop)(np.exp(2j * math.pi * frequencies / loop_design.sample_rate))
            style: CurveStyle = {
                "colour": index if len(loops) > 1 else int(not dashed),
                "dashed": dashed,
            }
            decibels = 20.0 * np.log10(np.abs(values))
            degrees = np.degrees(np.unwrap(np.angle(values)))
            gains.append(Curve(prefix + label, frequencies, decibels, **style))
            phases.append(Curve(prefix + label, frequencies, degrees, **style))
    if len(loops) == 1:
        gain, phase = _margins(loop_design, frequencies[[0, -1]])
        gains, phases = gains + gain, phases + phase
    axis = "frequency [Hz]"
    return [
        Plot("Bode: gain", axis, "gain [dB]", tuple(gains), x_log=True),
        Plot("Bode: phase", axis, "phase [°]", tuple(phases), x_log=True),
    ]


def _margins(loop_design: LoopAnalysis, ends: np.ndarray) -> tuple[list[Curve], list[Curve]]:
    """Return curves that mark margins and bandwidth in the plots of gain and phase.

    Args:
        loop_design: the loop.
        ends: ends of the frequency axis [Hz].
    """
    margin = 20.0 * math.log10(loop_design.gain_margin)
    gains = [
        Curve("0 dB", ends, np.zeros(2), reference=True),
        _vertical_line(f"gain margin {margin:.1f} dB", loop_design.phase_crossover, -margin, 0.0),
    ]
    phases = [Curve("\N{MINUS SIGN}180°", ends, np.full(2, -180.0), reference=True)]
    if math.isfinite(loop_design.bandwidth):
        label = f"bandwidth {loop_design.bandwidth:.4g} Hz at \N{MINUS SIGN}3 dB"
        gains.append(
            Curve(
                label,
                np.array([loop_design.bandwidth]),
                np.array([-3.0103]),
                style="dots",
                colour=1,
            )
        )
    if math.isfinite(loop_design.phase_margin):
        label = f"phase margin {loop_design.phase_margin:.1f}° at {loop_design.crossover:.4g} Hz"
        phases.append(
            _vertical_line(label, loop_design.crossover, -180.0, loop_design.phase_margin - 180.0)
        )
    return gains, phases


def _vertical_line(label: str, x: float, low: float, high: float) -> Curve:
    # uPlot needs increasing x: the upper end is minimally shifted.
    return Curve(label, np.array([x, x * (1.0 + 1e-6)]), np.array([low, high]), colour=3)


def small_step_plots(loops: Loops) -> list[Plot]:
    """Return small steps of the current with the shaft held, as shares of the reference.

    For a single loop the voltage is plotted too.
    """
    curves = []
    for index, (name, loop) in enumerate(loops.items()):
        step = small_step_response(*loop)
        settled, reference = step.settling_time(), float(step.reference[-1])
        num_samples = max(int(3.0 * np.searchsorted(step.time, settled)), 20)
        step = Response(*(column[:num_samples] for column in step))
        time, share = 1e3 * step.time, step.current / reference
        if len(loops) > 1:
            curves.append(Curve(f"{name}: current", time, share, colour=index))
    title, second_axis, voltage = "A small step of the current, the shaft held", None, []
    if len(loops) == 1:
        within = (
            f"within 2 % in {1e3 * settled:.3g} ms" if math.isfinite(settled) else "not settled"
        )
        torque = f"{loop[0].motor.torque_constant * reference:.3g} N·m at the rotor"
        curves = [
            Curve(f"current, of {reference:.3g} A, {torque}: {within}", time, share, colour=1)
        ]
        second_axis, voltage = ("current [A]", reference), [_voltages(loop[0], {"voltage": step})]
    curves.append(Curve("reference", time, np.ones(len(time)), reference=True))
    return [
        Plot(title, "time [ms]", "share of the reference", tuple(curves), second_axis=second_axis),
        *voltage,
    ]


def recovery_plots(drive: Drive, steps: StepResponses) -> list[Plot]:
    """Return recoveries from an unreachable reference by kind of anti-windup, and a close-up."""
    responses = {}
    for kind, response in steps.recoveries.items():
        recovery_time = response.settling_time(0.05)
        time_text = (
            f"{1e3 * recovery_time:.2g} ms" if math.isfinite(recovery_time) else "over 100 ms"
        )
        responses[f"{kind.replace('_', ' ')}: back in {time_text}"] = response
    speed_text = f"at {steps.speed:.4g} rad/s of the rotor"
    title = f"{steps.unreachable:.3g} A, out of reach, then {steps.reachable:.3g} A, {speed_text}"
    return [
        *_responses(drive, title, responses, _RECOVERY_SPAN),
        *_responses(drive, "Close-up", responses, _CLOSE_UP_SPAN),
    ]


def _responses(
    drive: Drive, title: str, responses: Mapping[str, Response], span: tuple[float, float]
) -> list[Plot]:
    """Return current and voltage of responses to one reference, within a span [ms]."""
    cropped = {}
    for label, response in responses.items():
        is_within = (1e3 * response.time >= span[0]) & (1e3 * response.time <= span[1])
        cropped[label] = Response(*(column[is_within] for column in response))
    currents = [
        Curve(label, 1e3 * response.time, response.current) for label, response in cropped.items()
    ]
    last = list(cropped.values())[-1]
    reference = Curve("reference", 1e3 * last.time, last.reference, reference=True, style="step")
    torque = "torque of the rotor [N·m]", drive.motor.torque_constant
    return [
        Plot(title, "time [ms]", "current [A]", (*currents, reference), second_axis=torque),
        _voltages(
            drive, {label.partition(":")[0]: response for label, response in cropped.items()}
        ),
    ]


def _voltages(loop: CurrentLoopActuator, responses: Mapping[str, Response]) -> Plot:
    """Return the voltage of responses, with the limits of the supply."""
    color = None if len(responses) > 1 else 1
    curves = [
        Curve(label, 1e3 * response.time, response.voltage, style="step", colour=color)
        for label, response in responses.items()
    ]
    if (limit := loop.voltage_limit) is not None:
        ends = curves[0].x[[0, -1]]
        curves += [
            Curve("supply", ends, np.full(2, side * limit), reference=True) for side in (1.0, -1.0)
        ]
    return Plot("Voltage", "time [ms]", "voltage [V]", tuple(curves))


def torque_step_plot(steps: Mapping[str, tuple[ActuatorModel, float, float]]) -> Plot | None:
    """Return the torque after a step of the desired torque, with the shaft held.

    Actuators without a state, or whose torque depends on the motion, are left out.

    Args:
        steps: name -> the actuator, the desired torque [N*m], and the mechanical step [s].

    Returns:
        None if no actuator is left.
    """
    curves = []
    for name, (actuator, desired, timestep) in steps.items():
        kind = type(actuator)
        if (
            not actuator.is_torque_controlled
            or actuator.MOTION
            or not kind.State._fields
            or desired == 0.0
        ):
            continue
        parameters = parameters_type(kind)(*actuator.parameter_values)
        state: FamilyTuple = kind.State._make([0.0] * len(kind.State._fields))
        share = [0.0]
        for tick in range(100):
            inputs = Inputs(desired, 0.0, 0.0, tick * timestep, 0.0)
            state, torque, _ = kind.advance(parameters, timestep, state, inputs)
            share.append(torque / desired)
        time = timestep * np.arange(len(share))
        unsettled = np.flatnonzero(np.abs(np.array(share) - share[-1]) > 0.02)
        num_points = min(max(3 * (unsettled[-1] + 1) if len(unsettled) else 0, 20), len(share))
        label = f"{name}, at steps of {1e3 * timestep:.3g} ms"
        curves.append(Curve(label, time[:num_points], np.array(share[:num_points])))
    if not curves:
        return None
    longest = max((curve.x for curve in curves), key=lambda time: time[-1])
    curves.append(Curve("reference", longest, np.ones(len(longest)), reference=True))
    return Plot(
        "A step of the torque, the shaft held",
        "time [s]",
        "share of the reference",
        tuple(curves),
    )
