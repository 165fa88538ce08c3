"""A motor's page: its numbers and where they are from, what it can do, its current loop."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup

from codrl_mj.actuators import Drive
from codrl_mj.catalogue import MotorEntry
from codrl_mj.drives import explain, step, unknown_in_words
from codrl_mj.pages import page
from codrl_mj.pages.diagrams import recoveries, torque_speed_diagram
from codrl_mj.pages.loop import loop_section, rates_table


def motor_page(name: str, drive: Drive, entry: MotorEntry | None, out: Path) -> Path:
    """Write the page of a motor with its drive, and its datasheet where it has one, to an .html file; return that."""
    known = explain(drive, entry)
    sections = [
        page.Section("abilities", "What it can do", _abilities(known, drive, entry)),
        page.Section("loop", "Its current loop", _loop(name, drive)),
        page.Section("numbers", "The motor, at its rotor", _numbers(known)),
        page.Section("drive", "As it is simulated", _values("Fields of the drive", known["drive"])),
    ]
    kicker = "A motor"
    top = Markup()
    if entry is not None:
        top = page.paragraph(f"{entry.title}.", "lead")
        if entry.notes:
            top += page.paragraph(" ".join(entry.notes.split()))
        for text in known["disagreements"]:
            top += page.note(f"The datasheet disagrees with itself: {text}")
    return page.write(out, page.page(name, kicker, top, sections))


def _values(caption: str, rows: Any) -> Markup:
    made = [(row["name"].replace("_", " "), page.number(row["value"]), page.unit(row["unit"])) for row in rows]
    return page.table(caption, ("number", "value", "unit"), made, numbers=(1,))


def _abilities(known: Mapping[str, Any], drive: Drive, entry: MotorEntry | None) -> Markup:
    table = _values(f"At the output of its gear, past friction, at {drive.voltage_limit:g} V", known["abilities"])
    if known["assumed"]:
        table += page.paragraph(f"{known['assumed']}.", "soft")
    try:
        plots = page.plots([torque_speed_diagram(drive, entry and entry.numbers)])
    except ValueError as error:
        plots = page.note(str(error))
    return Markup('<div class="beside">{}{}</div>').format(plots, table)


def _loop(name: str, drive: Drive) -> Markup:
    parts = [loop_section({name: (drive, None)})]
    try:
        parts += [page.heading("Out of saturation, by kind of anti-windup"), page.plots(recoveries(drive, step(drive)))]
    except ValueError as error:
        parts = [parts[0], page.note(str(error))]
    return page.joined((*parts, rates_table(drive)))


def _numbers(known: Mapping[str, Any]) -> Markup:
    """Every number of a datasheet with its origin."""
    if "numbers" not in known:
        return Markup()
    rows = []
    for row in known["numbers"]:
        how = row["how"] + (" (estimated)" if row["name"] in known["estimated"] else "")
        cells = row["name"].replace("_", " "), page.number(row["value"]), page.unit(row["unit"]), how, row["places"]
        rows.append(cells)
    columns = ("number", "value", "unit", "how it came about", "source")
    parts = [page.table("Numbers and where they are from", columns, rows, numbers=(1,), cards=True)]
    parts.append(page.definitions((str(place), source) for place, source in enumerate(known["cited"], 1)))
    if known["estimated"]:
        parts += [page.heading("Estimated"), page.definitions(known["estimated"].items())]
    if known["unknown"]:
        parts.append(page.paragraph(unknown_in_words(known["unknown"]), "soft"))
    return page.joined(parts)
