"""What lies between what is asked of an actuator and what it delivers: steps, frequency response, torque and speed."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from codrl_mj.actuators import Actuator, ActuatorModel, Drive, Inputs, TorqueSpeed, parameters_type
from codrl_mj.drives import LoopDesign, design, designs, torque_limits
from codrl_mj.pages import page
from codrl_mj.pages.diagrams import Loops, bode, small_steps
from codrl_mj.pages.plots import Curve, Plot

_RIGHTS = (
    ("sample_rate", "sample rate", "Hz"),
    ("kp", "proportional gain", "V/A"),
    ("ki", "integral gain", "V/(A·s)"),
    ("gain_margin", "gain margin", "dB"),
    ("phase_margin", "phase margin", "°"),
    ("crossover", "crossover", "Hz"),
    ("bandwidth", "bandwidth, to 1/√2,", "Hz"),
    ("settling_time", "settled to 2 % in", "ms"),
    ("overshoot", "overshoot", "%"),
)
_SCALES = {"settling_time": 1e3, "overshoot": 100.0}


def loop_section(loops: Loops) -> Markup:
    """Margins, Bode's diagram and a small step of some current loops."""
    found: dict[str, LoopDesign] = {}
    notes = []
    for name, (one, timestep) in loops.items():
        try:
            found[name] = design(one, timestep)
        except ValueError as error:
            notes.append(page.note(f"{name}: {error}", bad=True))
    if not found:
        return page.joined(notes)
    rows = [
        (label, *(page.number(_right(one, field)) for one in found.values()), unit) for field, label, unit in _RIGHTS
    ]
    late = {name: "a sample of delay" if one.delayed else "no delay" for name, one in found.items()}
    rows.append(("the voltage comes with", *late.values(), ""))
    table = page.table("Current loop", ("", *found, "unit"), rows, numbers=range(1, 1 + len(found)))
    if any(math.isnan(_right(one, field)) for one in found.values() for field, _, _ in _RIGHTS):
        notes.append(page.paragraph("–: not below half the sample rate, or not within sight.", "soft"))
    known = {name: loops[name] for name in found}
    return page.joined((table, *notes, page.plots((*bode(known, found), *small_steps(known)))))


def _right(one: LoopDesign, field: str) -> float:
    value = getattr(one, field)
    return 20.0 * math.log10(value) if field == "gain_margin" else value * _SCALES.get(field, 1.0)


def rates_table(drive: Drive) -> Markup:
    """The loop at other sample rates, with and without delay."""
    own = drive.controller.sample_rate, drive.controller.delayed
    rows = []
    for (rate, delayed), one in designs(drive).items():
        name = f"{rate / 1e3:g} kHz, {'a sample' if delayed else 'no'} delay{' (as it is)' * ((rate, delayed) == own)}"
        if isinstance(one, str):
            rows.append((name, "not possible: " + one, *[""] * 5))
        else:
            rows.append((name, *(page.number(_right(one, field)) for field, _, _ in _RIGHTS[3:])))
    columns = ("the loop at", *(f"{label} [{unit}]" for _, label, unit in _RIGHTS[3:]))
    return page.table("Other sample rates", columns, rows, numbers=range(1, 7), cards=True)


def held_step(steps: Mapping[str, tuple[ActuatorModel, float, float]]) -> Plot | None:
    """The torque after a step of what is asked for, the shaft held; None where nothing is of interest.

    By name: the actuator, the torque that is asked of it [N*m], the mechanical step [s].
    """
    curves = []
    for name, (actuator, asked, timestep) in steps.items():
        kind: Any = type(actuator)
        if not actuator.tracks or actuator.MOTION or not kind.State._fields or asked == 0.0:
            continue
        parameters, state = parameters_type(kind)(*actuator.numbers), kind.State(*[0.0] * len(kind.State._fields))
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
    return Plot("A step of the torque, the shaft held", "time [s]", "share of what is asked for", tuple(curves))


def limits(actuator: Any, speeds: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Lowest and highest torque [N*m] that an actuator delivers at speeds [rad/s]; None where it has no such limits.

    The joint's friction, which the model has, is not taken off.
    """
    if isinstance(actuator, Drive):
        free = {f"motor.{name}": 0.0 for name in ("coulomb_friction", "viscous_friction", "stribeck_friction")}
        return torque_limits(actuator.replaced(free), speeds, actuator.controller.max_current)
    if isinstance(actuator, TorqueSpeed):
        ends = (actuator.stall_torque * (side - speeds / actuator.no_load_speed) for side in (-1.0, 1.0))
        low, high = (np.clip(end, -actuator.max_torque, actuator.max_torque) for end in ends)
        return low, high
    if isinstance(actuator, Actuator) and actuator.voltage_limit is not None:
        motor, volts = actuator.motor, actuator.voltage_limit
        low, high = (
            motor.torque_constant * (side * volts - motor.back_emf_constant * speeds) / motor.resistance
            for side in (-1, 1)
        )
        return low, high
    return None


def no_load_speed(actuator: Any) -> float:
    """Where the voltage makes no more torque [rad/s], before friction; infinite where nothing is known of it."""
    if isinstance(actuator, TorqueSpeed):
        return float(actuator.no_load_speed)
    if isinstance(actuator, Drive | Actuator) and actuator.voltage_limit is not None:
        constant = actuator.motor.back_emf_constant * getattr(actuator.motor, "gear_ratio", 1.0)
        return float(actuator.voltage_limit / constant) if constant > 0.0 else math.inf
    return math.inf
