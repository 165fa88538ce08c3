"""Page of a motor: its numbers with their sources, its limits, and its current loop."""

import math
from collections.abc import Iterable
from pathlib import Path

from markupsafe import Markup

from codrl_mj.actuators import Drive, PwmServo
from codrl_mj.catalogue import MotorEntry
from codrl_mj.sizing import (
    LoopAnalysis,
    analyze_loop,
    analyze_sample_rates,
    describe_motor,
    describe_unknown,
    step_responses,
)
from codrl_mj.sizing.limits import MotorReport, Quantity
from codrl_mj.sizing.servo_response import PositionServo, ServoResponse
from codrl_mj.viz.pages import page
from codrl_mj.viz.pages.diagrams import (
    Loops,
    bode_plots,
    recovery_plots,
    small_step_plots,
    torque_speed_diagram,
)
from codrl_mj.viz.pages.servo_diagrams import servo_plots

_LOOP_ROWS = (
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
    """Return margins, Bode plots and small steps of current loops."""
    designs_by_name: dict[str, LoopAnalysis] = {}
    notes = []
    for name, (loop, timestep) in loops.items():
        try:
            designs_by_name[name] = analyze_loop(loop, timestep)
        except ValueError as error:
            notes.append(page.note(f"{name}: {error}", bad=True))
    if not designs_by_name:
        return page.join(notes)
    rows = [
        (
            label,
            *(page.format_number(_display_value(loop, field)) for loop in designs_by_name.values()),
            unit,
        )
        for field, label, unit in _LOOP_ROWS
    ]
    delay_texts = {
        name: "a sample of delay" if loop.delayed else "no delay"
        for name, loop in designs_by_name.items()
    }
    rows.append(("voltage applied with", *delay_texts.values(), ""))
    table = page.table(
        "Current loop",
        ("", *designs_by_name, "unit"),
        rows,
        numbers=range(1, 1 + len(designs_by_name)),
    )
    if any(
        math.isnan(_display_value(loop, field))
        for loop in designs_by_name.values()
        for field, _, _ in _LOOP_ROWS
    ):
        notes.append(
            page.paragraph(
                "–: above half the sample rate, or not reached in the simulated time.", "soft"
            )
        )
    stable_loops = {name: loops[name] for name in designs_by_name}
    return page.join(
        (
            table,
            *notes,
            page.plots(
                (*bode_plots(stable_loops, designs_by_name), *small_step_plots(stable_loops))
            ),
        )
    )


def _display_value(loop_design: LoopAnalysis, field: str) -> float:
    value = getattr(loop_design, field)
    return 20.0 * math.log10(value) if field == "gain_margin" else value * _SCALES.get(field, 1.0)


def motor_page(
    name: str,
    drive: Drive,
    entry: MotorEntry | None,
    out: Path,
    servo: PositionServo | None = None,
    response: ServoResponse | None = None,
) -> Path:
    """Write the page of a motor with its drive, and its datasheet if it has one.

    A servo has its responses on the page; one without a current loop has no section on that.

    Return the file.
    """
    explanation = describe_motor(drive, entry, None if servo is None else servo.loop)
    sections = [page.Section("abilities", "Limits", _abilities(explanation, drive, entry))]
    if servo is not None and response is not None:
        plots = page.plots(servo_plots(servo, response))
        sections.append(page.Section("servo", "Servo", plots))
    if not isinstance(servo, PwmServo):
        sections.append(page.Section("loop", "Current loop", _loop(name, drive)))
    sections += [
        page.Section("numbers", "The motor, at its rotor", _numbers(explanation)),
        page.Section(
            "drive", "As it is simulated", _values("Fields of the drive", explanation["drive"])
        ),
    ]
    top = Markup()
    if entry is not None:
        top = page.paragraph(f"{entry.title}.", "lead")
        if entry.notes:
            top += page.paragraph(" ".join(entry.notes.split()))
        for text in explanation["disagreements"]:
            top += page.note(f"The datasheet disagrees with itself: {text}")
    return page.write(out, page.page(name, "A motor", top, sections))


def _values(caption: str, rows: Iterable[Quantity]) -> Markup:
    cells = [
        (
            row["name"].replace("_", " "),
            page.format_number(row["value"]),
            page.format_unit(row["unit"]),
        )
        for row in rows
    ]
    return page.table(caption, ("number", "value", "unit"), cells, numbers=(1,))


def _abilities(explanation: MotorReport, drive: Drive, entry: MotorEntry | None) -> Markup:
    table = _values(
        f"At the output of the gear, friction subtracted, at {drive.voltage_limit:g} V",
        explanation["abilities"],
    )
    if explanation["assumed"]:
        table += page.paragraph(f"{explanation['assumed']}.", "soft")
    try:
        plots = page.plots(
            [torque_speed_diagram(drive, None if entry is None else entry.parameters)]
        )
    except ValueError as error:
        plots = page.note(str(error))
    return Markup('<div class="beside">{}{}</div>').format(plots, table)


def _loop(name: str, drive: Drive) -> Markup:
    """Return the loop as designed, out of saturation, and at other sample rates and delays."""
    parts = [loop_section({name: (drive, None)})]
    try:
        parts += [
            page.heading("Out of saturation, by kind of anti-windup"),
            page.plots(recovery_plots(drive, step_responses(drive))),
        ]
    except ValueError as error:
        parts = [parts[0], page.note(str(error))]
    current_setting = drive.controller.sample_rate, drive.controller.delayed
    rows = []
    for (rate, delayed), candidate in analyze_sample_rates(drive).items():
        name = (
            f"{rate / 1e3:g} kHz, {'a sample' if delayed else 'no'}"
            f" delay{' (as it is)' * ((rate, delayed) == current_setting)}"
        )
        if isinstance(candidate, str):
            rows.append((name, "not possible: " + candidate, *[""] * 5))
        else:
            rows.append(
                (
                    name,
                    *(
                        page.format_number(_display_value(candidate, field))
                        for field, _, _ in _LOOP_ROWS[3:]
                    ),
                )
            )
    columns = ("the loop at", *(f"{label} [{unit}]" for _, label, unit in _LOOP_ROWS[3:]))
    return page.join(
        (*parts, page.table("Other sample rates", columns, rows, numbers=range(1, 7), cards=True))
    )


def _numbers(explanation: MotorReport) -> Markup:
    """Return every number of a datasheet with its source."""
    if "numbers" not in explanation:
        return Markup()
    rows = []
    for row in explanation["numbers"]:
        derivation = row["how"] + (
            " (estimated)" if row["name"] in explanation["estimated"] else ""
        )
        cells = (
            row["name"].replace("_", " "),
            page.format_number(row["value"]),
            page.format_unit(row["unit"]),
            derivation,
            row["places"],
        )
        rows.append(cells)
    columns = ("number", "value", "unit", "derivation", "source")
    parts = [page.table("Numbers and their sources", columns, rows, numbers=(1,), cards=True)]
    parts.append(
        page.definitions(
            (str(index), source) for index, source in enumerate(explanation["cited"], 1)
        )
    )
    if explanation["estimated"]:
        parts += [page.heading("Estimated"), page.definitions(explanation["estimated"].items())]
    if explanation["unknown"]:
        parts.append(page.paragraph(describe_unknown(explanation["unknown"]), "soft"))
    return page.join(parts)
