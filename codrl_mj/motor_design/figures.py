"""The pictures: torque over speed, Bode's diagram of the current loop, step responses; in SI units, on white."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from codrl_mj.actuators import Drive
from codrl_mj.motor_design.drives import abilities, diagram_limits, torque_limits
from codrl_mj.motor_design.loop import Response, closed_loop, design, open_loop
from codrl_mj.motor_design.windup import Steps
from codrl_mj.runs.files import writing

BLACK, BLUE, RED, GREEN = "#000000", "#0072B2", "#D55E00", "#009E73"
"""Of Okabe and Ito's palette, which the colour-blind can tell apart."""


def torque_speed_diagram(drive: Drive, numbers: Any = None, points: Any = None) -> Any:
    """What a drive can do at the output of its gear, in all four quadrants, past friction: see `torque_limits`.

    Args:
        drive: whose voltage, `max_current`, gear and friction are drawn.
        numbers: `codrl_mj.catalogue.MotorNumbers`, for the continuous current; None where it is not known.
        points: shape (n, 2), operating points to lay over it: speed [rad/s] and torque [N*m] of the output.

    Returns:
        A matplotlib `Figure`.

    Raises:
        ValueError: the drive has no no-load speed to end the diagram at, or `points` have another shape.
    """
    can, most, lines = abilities(drive), drive.controller.max_current, diagram_limits(drive, numbers)
    points = np.empty((0, 2)) if points is None else np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points: shape {points.shape}, must be (n, 2): speed [rad/s] and torque [N*m]")
    width = 1.15 * max(can.no_load_speed, *np.abs(points[:, 0]), 0.0)
    height = 1.25 * max(min(can.stall_torque, 3.0 * can.peak_torque), *np.abs(points[:, 1]), 0.0)
    half = np.linspace(0.0, width, 400)[1:]
    speeds = np.concatenate([-half[::-1], [-1e-9 * width, 1e-9 * width], half])  # friction changes sign at standstill

    figure, axes = _figure(1, (8.0, 5.6))
    axes = axes[0]
    axes.fill_between(speeds, *torque_limits(drive, speeds, most), color=BLUE, alpha=0.12, linewidth=0)
    for label, current, place in lines:
        colour, style = ((BLUE, "-"), (RED, "-"), (GREEN, "--"))[place]
        for bound, text in zip(torque_limits(drive, speeds, current), (None, label), strict=True):
            axes.plot(speeds, bound, style, color=colour, label=text, linewidth=1.6)
    off = " (off the picture)" if can.stall_torque > height else ""
    stall = f"stall, {can.stall_torque:,.4g} N·m, {can.stall_current:,.4g} A{off}"
    axes.plot([0, 0], [can.stall_torque, -can.stall_torque], "s", color=BLACK, label=stall)
    free = f"no load, {can.no_load_speed:.4g} rad/s"
    axes.plot([can.no_load_speed, -can.no_load_speed], [0, 0], "o", color=BLACK, label=free)
    if len(points):
        axes.plot(*points.T, ".", color="0.35", markersize=3, alpha=0.6, label="operating points", zorder=1.5)
    for x, across in ((0.015, "left"), (0.985, "right")):
        for y, along in ((0.015, "bottom"), (0.985, "top")):
            text = "driving" if (x > 0.5) == (y > 0.5) else "braking"
            axes.text(x, y, text, transform=axes.transAxes, color="0.4", ha=across, va=along)
    axes.axhline(0.0, color="0.5", linewidth=0.8)
    axes.axvline(0.0, color="0.5", linewidth=0.8)
    gear = f"behind a gear of {drive.motor.gear_ratio:g}:1" if drive.motor.gear_ratio != 1.0 else "without a gear"
    axes.set(xlim=(-width, width), ylim=(-height, height), xlabel="speed of the output [rad/s]")
    axes.set(ylabel="torque of the output [N·m]", title=f"Torque and speed {gear}, friction taken off")
    figure.legend(loc="outside lower center", ncols=2, fontsize="small")
    return figure


def bode_diagram(drive: Drive) -> Any:
    """Bode's diagram of the current loop, open and closed, with its margins and its bandwidth.

    Raises:
        ValueError: the loop is unstable.
    """
    from matplotlib.ticker import MultipleLocator

    found, rate = design(drive), drive.controller.sample_rate
    lowest = np.nanmin([1e-3 * rate, 0.02 * found.crossover])
    frequencies = np.geomspace(lowest, 0.49999 * rate, 1500)
    figure, (gain, phase) = _figure(2, (8.0, 6.4), sharex=True)
    loops = (("open loop", open_loop(drive), BLUE), ("closed loop", closed_loop(drive), RED))
    for label, loop, colour in loops:
        values = loop(np.exp(2j * math.pi * frequencies / rate))
        gain.semilogx(frequencies, 20.0 * np.log10(np.abs(values)), color=colour, label=label)
        phase.semilogx(frequencies, np.degrees(np.unwrap(np.angle(values))), color=colour)
    gain.axhline(0.0, color="0.5", linewidth=0.8)
    phase.axhline(-180.0, color="0.5", linewidth=0.8)
    decibels = 20.0 * math.log10(found.gain_margin)
    gain.plot(
        [found.phase_crossover] * 2,
        [-decibels, 0.0],
        color=GREEN,
        linewidth=2.5,
        label=f"gain margin, {decibels:.1f} dB",
    )
    if math.isfinite(found.phase_margin):
        label = f"phase margin, {found.phase_margin:.1f}° at {found.crossover:.4g} Hz"
        low = -180.0, found.phase_margin - 180.0
        phase.plot([found.crossover] * 2, low, color=BLACK, linewidth=2.5, label=label)
        gain.axvline(found.crossover, color=BLACK, linewidth=0.8, linestyle=":")
    if math.isfinite(found.bandwidth):
        label = f"bandwidth, {found.bandwidth:.4g} Hz at \N{MINUS SIGN}3 dB"
        gain.plot(found.bandwidth, -3.0103, "o", color=RED, label=label)
    late = "a sample of delay" if found.delayed else "no delay"
    title = f"Current loop at {rate / 1e3:g} kHz, {late}: kp = {found.kp:.4g} V/A, ki = {found.ki:,.5g} V/(A·s)"
    gain.set(ylabel="gain [dB]", title=title)
    phase.set(xlabel="frequency [Hz]", ylabel="phase [°]", xlim=(frequencies[0], 0.55 * rate))
    phase.yaxis.set_major_locator(MultipleLocator(45.0))
    figure.legend(loc="outside lower center", ncols=3, fontsize="small")
    return figure


def step_diagram(drive: Drive, steps: Steps) -> Any:
    """Current, torque and voltage of the steps that `codrl_mj.motor_design.step` took with a drive."""
    figure, (currents, voltages) = _figure(2, (14.0, 6.4), columns=3)
    _draw(currents[0], voltages[0], steps.small, BLUE, "sampled current")
    for (kind, recovery), colour in zip(steps.recoveries.items(), (BLUE, GREEN, RED), strict=True):
        text = f"{1e3 * recovery.time:.2g} ms" if math.isfinite(recovery.time) else "over 100 ms"
        for current, voltage in zip(currents[1:], voltages[1:], strict=True):
            _draw(current, voltage, recovery.response, colour, f"{kind}: back in {text}")
    settled = steps.small.settling_time()
    whole, limit = 1e3 * float(steps.small.time[-1]), drive.voltage_limit
    spans = (0.0, min(3e3 * settled, whole) if settled > 0.0 else whole), (0.0, 60.0), (19.5, 24.0)
    within = f"within 2 % in {1e3 * settled:.3g} ms" if math.isfinite(settled) else "not settled"
    titles = (
        f"Small step at standstill: {within}",
        f"{steps.unreachable:.3g} A, out of reach, then {steps.reachable:.3g} A, at {steps.speed:.4g} rad/s",
        "The same, close",
    )
    constant = drive.motor.torque_constant
    torque = lambda current: constant * current, lambda torque: torque / constant
    responses = steps.small, recovery.response, recovery.response
    for current, voltage, span, title, response in zip(currents, voltages, spans, titles, responses, strict=True):
        current.step(1e3 * response.time, response.reference, "--", color=BLACK, where="post", label="reference")
        current.set(xlim=span, ylabel="current [A]")
        current.set_title(title, fontsize="medium")
        for side in (-1.0, 1.0):
            voltage.axhspan(side * limit, side * 1.3 * limit, color="0.88", linewidth=0)
        voltage.text(
            0.5, 0.965, "beyond the supply", transform=voltage.transAxes, ha="center", va="center", color="0.3"
        )
        voltage.set(xlim=span, ylim=(-1.15 * limit, 1.15 * limit), xlabel="time [ms]", ylabel="voltage [V]")
        right = current.secondary_yaxis("right", functions=torque)
        right.set_ylabel("torque of the rotor [N·m]")
    currents[0].legend(fontsize="small", loc="lower right")
    figure.legend(*currents[1].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize="small")
    return figure


def _draw(current: Any, voltage: Any, response: Response, colour: str, label: str) -> None:
    """A response's current over its voltage, over milliseconds."""
    current.plot(1e3 * response.time, response.current, color=colour, label=label, linewidth=1.5)
    voltage.step(1e3 * response.time, response.voltage, color=colour, where="post", linewidth=1.5)


def save(figure: Any, path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    figure.set_facecolor("white")
    with writing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=150)


def _figure(rows: int, size: tuple[float, float], columns: int = 1, sharex: bool = False) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=sharex)
    for one in axes.flat:
        one.grid(color="0.9", which="both")
        one.set_axisbelow(True)
    return figure, axes if columns > 1 else axes[:, 0]
