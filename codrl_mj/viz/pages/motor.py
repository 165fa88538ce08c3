"""A motor's page: its numbers and where they are from, what it can do, its current loop."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup

from codrl_mj.actuators import Drive
from codrl_mj.catalogue import MotorEntry
from codrl_mj.sizing import LoopDesign, design, designs, explain, step_responses, describe_unknown
from codrl_mj.viz.pages import page
from codrl_mj.viz.pages.diagrams import Loops, bode, recoveries, small_steps, torque_speed_diagram

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
        (label, *(page.number(_right(one, field)) for one in found.values()), unit)
        for field, label, unit in _RIGHTS
    ]
    late = {name: "a sample of delay" if one.delayed else "no delay" for name, one in found.items()}
    rows.append(("the voltage comes with", *late.values(), ""))
    table = page.table("Current loop", ("", *found, "unit"), rows, numbers=range(1, 1 + len(found)))
    if any(math.isnan(_right(one, field)) for one in found.values() for field, _, _ in _RIGHTS):
        notes.append(
            page.paragraph("–: not below half the sample rate, or not within sight.", "soft")
        )
    known = {name: loops[name] for name in found}
    return page.joined((table, *notes, page.plots((*bode(known, found), *small_steps(known)))))


def _right(one: LoopDesign, field: str) -> float:
    value = getattr(one, field)
    return 20.0 * math.log10(value) if field == "gain_margin" else value * _SCALES.get(field, 1.0)


def motor_page(name: str, drive: Drive, entry: MotorEntry | None, out: Path) -> Path:
    """Write the page of a motor with its drive, and its datasheet where it has one, to an .html file; return that."""
    known = explain(drive, entry)
    sections = [
        page.Section("abilities", "What it can do", _abilities(known, drive, entry)),
        page.Section("loop", "Its current loop", _loop(name, drive)),
        page.Section("numbers", "The motor, at its rotor", _numbers(known)),
        page.Section("drive", "As it is simulated", _values("Fields of the drive", known["drive"])),
    ]
    top = Markup()
    if entry is not None:
        top = page.paragraph(f"{entry.title}.", "lead")
        if entry.notes:
            top += page.paragraph(" ".join(entry.notes.split()))
        for text in known["disagreements"]:
            top += page.note(f"The datasheet disagrees with itself: {text}")
    return page.write(out, page.page(name, "A motor", top, sections))


def _values(caption: str, rows: Any) -> Markup:
    made = [
        (row["name"].replace("_", " "), page.number(row["value"]), page.unit(row["unit"]))
        for row in rows
    ]
    return page.table(caption, ("number", "value", "unit"), made, numbers=(1,))


def _abilities(known: Mapping[str, Any], drive: Drive, entry: MotorEntry | None) -> Markup:
    table = _values(
        f"At the output of its gear, past friction, at {drive.voltage_limit:g} V",
        known["abilities"],
    )
    if known["assumed"]:
        table += page.paragraph(f"{known['assumed']}.", "soft")
    try:
        plots = page.plots([torque_speed_diagram(drive, entry and entry.numbers)])
    except ValueError as error:
        plots = page.note(str(error))
    return Markup('<div class="beside">{}{}</div>').format(plots, table)


def _loop(name: str, drive: Drive) -> Markup:
    """The loop as it is, out of saturation, and at other sample rates, with and without delay."""
    parts = [loop_section({name: (drive, None)})]
    try:
        parts += [
            page.heading("Out of saturation, by kind of anti-windup"),
            page.plots(recoveries(drive, step_responses(drive))),
        ]
    except ValueError as error:
        parts = [parts[0], page.note(str(error))]
    own = drive.controller.sample_rate, drive.controller.delayed
    rows = []
    for (rate, delayed), one in designs(drive).items():
        name = (
            f"{rate / 1e3:g} kHz, {'a sample' if delayed else 'no'}"
            f" delay{' (as it is)' * ((rate, delayed) == own)}"
        )
        if isinstance(one, str):
            rows.append((name, "not possible: " + one, *[""] * 5))
        else:
            rows.append((name, *(page.number(_right(one, field)) for field, _, _ in _RIGHTS[3:])))
    columns = ("the loop at", *(f"{label} [{unit}]" for _, label, unit in _RIGHTS[3:]))
    return page.joined(
        (*parts, page.table("Other sample rates", columns, rows, numbers=range(1, 7), cards=True))
    )


def _numbers(known: Mapping[str, Any]) -> Markup:
    """Every number of a datasheet with its origin."""
    if "numbers" not in known:
        return Markup()
    rows = []
    for row in known["numbers"]:
        how = row["how"] + (" (estimated)" if row["name"] in known["estimated"] else "")
        cells = (
            row["name"].replace("_", " "),
            page.number(row["value"]),
            page.unit(row["unit"]),
            how,
            row["places"],
        )
        rows.append(cells)
    columns = ("number", "value", "unit", "how it came about", "source")
    parts = [page.table("Numbers and where they are from", columns, rows, numbers=(1,), cards=True)]
    parts.append(
        page.definitions((str(place), source) for place, source in enumerate(known["cited"], 1))
    )
    if known["estimated"]:
        parts += [page.heading("Estimated"), page.definitions(known["estimated"].items())]
    if known["unknown"]:
        parts.append(page.paragraph(describe_unknown(known["unknown"]), "soft"))
    return page.joined(parts)
