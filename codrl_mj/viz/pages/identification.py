"""What identification found: data and fit, residuals, intervals, correlations, and what to do better on the bench."""

import itertools
import math
from pathlib import Path

import numpy as np
from markupsafe import Markup

from codrl_mj.identify.log import SIGNALS
from codrl_mj.identify.result import USABLE, Identified, Trace
from codrl_mj.identify.uncertainty import CAUSES
from codrl_mj.viz.pages import page
from codrl_mj.viz.pages.plots import Curve, Plot

_LAGS = 400
_STRONG = 0.9
_ADVICE = {
    "resistance": (
        "lock the rotor, drive it with steps of voltage (PRBS), log voltage and current at the"
        " terminals"
    ),
    "inductance": "lock the rotor, and log several rows within L/R of every step of the voltage",
    "back_emf_constant": (
        "log voltage and current while the shaft turns fast: a slow, large sine of the voltage"
    ),
    "torque_constant": (
        "measure it with a known mass (--known mgl=…), or give the datasheet's with --known"
    ),
    "torque_gain": "hang a known mass and give --known mgl=…: all torques scale with it",
    "inertia": "accelerate and brake hard: steps of the input, in both directions",
    "rotor_inertia": "log the motor without its load, or give --known load_inertia=…",
    "mgl": "let it swing further from the middle, or weigh it and give --known mgl=…",
    "constant_torque": "move the load up and down, several times",
    "coulomb_friction": "pass standstill often: a slow sine, in both directions",
    "viscous_friction": "hold several speeds up to the highest, in both directions",
    "friction_torque": "log longer, and several speeds in both directions",
    "gear_efficiency": "repeat the motion with two loads at least, driving and braking",
    "stribeck_friction": "creep: log very slow motion out of standstill",
    "stribeck_speed": "creep: log speeds from standstill to where friction is least",
}


def identification_page(found: Identified, out: Path) -> Path:
    """Write the page of what identification found."""
    winding = [one for one in found.traces if one.part == "winding"]
    shaft = [one for one in found.traces if one.part == "shaft"]
    predicted = [one.trace for one in found.held_out if one.trace is not None]
    fits = (
        [page.heading("Winding: the current under the logged voltage"), *map(_looked_at, winding)]
        if winding
        else []
    )
    fits += [page.heading("Shaft, piece by piece"), *map(_looked_at, shaft)] if shaft else []
    sections = [
        page.Section("parameters", "Parameters", _parameters(found)),
        page.Section("better", "What to do better on the bench", _advice(found)),
        page.Section("errors", "Errors of the simulation", _errors(found)),
        page.Section("fits", "Logs that were fitted", page.joined(fits)),
        page.Section(
            "held-out", "Logs that were only predicted", page.joined(map(_looked_at, predicted))
        ),
        page.Section(
            "correlations", "Which parameters can stand for each other", _correlations(found)
        ),
    ]
    title = f"Identified from {', '.join(found.logs)}"
    return page.write(out, page.page(title, "A motor from its bench logs", _top(found), sections))


def _top(found: Identified) -> Markup:
    problem = found.problem()
    by = f", driven by its {found.driven_by}" if found.driven_by else ""
    good = sum(one.status in USABLE for one in found.estimates)
    late = [
        f"the input of the {part} is late by {rows:g} row{'s' * (abs(rows) != 1)}, which is"
        " allowed for"
        for part, rows in found.delays.items()
        if rows
    ]
    told = (
        f"{good} of {len(found.estimates)} numbers can be relied on. Rig: {found.rig}{by};"
        f" friction: {found.friction}"
        + "".join(
            f"; {text}"
            for text in (found.friction_reason, found.supply_text, found.base_text)
            if text
        )
    )
    usable = "usable as an actuator" if problem is None else "not to be used as an actuator"
    parts = [
        page.judged(problem is None, usable, "p", "verdict"),
        page.paragraph("; ".join([told, *late]) + ".", "lead"),
    ]
    parts += [page.note(problem, bad=True)] if problem is not None else []
    return page.joined((*parts, *map(page.note, found.warnings)))


def _parameters(found: Identified) -> Markup:
    rows = []
    for one in found.estimates:
        interval = (
            "" if one.status == "given" else f"{page.number(one.low)} to {page.number(one.high)}"
        )
        half = 50.0 * (one.high - one.low) / abs(one.value) if one.value else math.nan
        worst = max(one.causes, key=lambda cause: one.causes[cause]) if one.causes else ""
        good = one.status in USABLE
        share = f"{half:.2g} %" if interval and math.isfinite(half) else ""
        unit, name = page.unit(one.unit), one.name.replace("_", " ")
        cells = (
            name,
            page.number(one.value),
            interval,
            share,
            unit,
            page.judged(good, one.status),
            one.why,
            CAUSES.get(worst, ""),
        )
        rows.append(cells)
    columns = (
        "parameter",
        "value",
        "95 % interval",
        "half of it",
        "unit",
        "status",
        "why",
        "mostly because",
    )
    failed = (place for place, one in enumerate(found.estimates) if one.status not in USABLE)
    return page.table("Parameters with 95 % intervals", columns, rows, (1, 2, 3), True, failed)


def _advice(found: Identified) -> Markup:
    texts = [
        Markup("<b>{}</b> is {}: {}.").format(
            one.name.replace("_", " "), one.status, _ADVICE[one.name]
        )
        for one in found.estimates
        if one.status not in ("identified", "given") and one.name in _ADVICE
    ]
    told = Markup(
        "<b>{}</b> and <b>{}</b> stand for each other (correlation {:+.2f}): give one of them with"
        " --known, or excite what tells them apart."
    )
    texts += [
        told.format(one.replace("_", " "), other.replace("_", " "), table[one][other])
        for table in found.correlations.values()
        for one, other in itertools.combinations(table, 2)
        if abs(table[one][other]) >= _STRONG
    ]
    if not found.held_out and found.driven_by:
        texts.append(
            Markup(
                "No log was held out: keep one back with --holdout, to see what the numbers"
                " predict."
            )
        )
    if len(found.logs) < 2:
        texts.append(Markup("A single log: a second one shows what differs from day to day."))
    if not texts:
        return page.paragraph(
            "Nothing stands out: every number is identified or given, and a log was held out."
        )
    texts.append(Markup("<code>codrl-mj identify plan</code> says which excitation tells what."))
    return Markup("<ul>{}</ul>").format(
        page.joined(Markup("<li>{}</li>").format(text) for text in texts)
    )


def _errors(found: Identified) -> Markup:
    rows = []
    for kind, several in (("fitted", found.fitted), ("held out", found.held_out)):
        for one in several:
            errors = (page.number(error, 3) for error in (one.open_loop, one.closed_loop))
            rows.append((one.log, kind, f"{one.output} [{SIGNALS[one.output]}]", *errors))
    if not rows:
        return Markup()
    columns = ("log", "", "of", "open loop, half a second", "closed loop")
    told = page.paragraph(
        "Mean absolute errors. Open loop: the simulation begins from where the shaft was and runs"
        " half a second under the logged input. Closed loop: over the whole log under the servo's"
        " own law, where the log has a command."
    )
    return told + page.table("Errors of the simulation", columns, rows, numbers=(3, 4))


def _looked_at(one: Trace) -> Markup:
    """Data and simulation of a log, residuals and their autocorrelation, which is small of noise."""
    from scipy.signal import correlate

    unit, what = SIGNALS[one.output], f"{one.log}: {one.output}"
    gaps = one.starts[1:]
    time, simulated = (np.insert(values, gaps, np.nan) for values in (one.time, one.simulated))
    time = np.where(
        np.isnan(time),
        np.interp(np.arange(len(time)), np.flatnonzero(~np.isnan(time)), one.time),
        time,
    )
    residuals = one.measured - one.simulated
    curves = (
        Curve("measured", one.time, one.measured, colour=0),
        Curve("simulated", time, simulated, colour=1),
    )
    off = Curve("residual", time, np.insert(residuals, gaps, np.nan), colour=4)
    centred = residuals - residuals.mean()
    whole = correlate(centred, centred, method="fft")[len(centred) - 1 :]
    count, bound = min(_LAGS, len(centred) // 2), 1.96 / math.sqrt(len(centred))
    lags = float(np.median(np.diff(one.time))) * np.arange(count + 1)
    shares = (
        Curve("autocorrelation", lags, whole[: count + 1] / max(whole[0], 1e-300), colour=3),
        Curve("95 % of noise", lags[[0, -1]], np.full(2, bound), reference=True),
        Curve("95 % of noise, below", lags[[0, -1]], np.full(2, -bound), reference=True),
    )
    return page.plots(
        (
            Plot(what, "time [s]", f"{one.output} [{unit}]", curves),
            Plot(f"{what}, residuals", "time [s]", f"measured less simulated [{unit}]", (off,)),
            Plot(f"{what}, autocorrelation of residuals", "lag [s]", "share", shares),
        )
    )


def _correlations(found: Identified) -> Markup:
    parts = []
    for part, table in found.correlations.items():
        if len(table) > 1:
            names = [name.replace("_", " ") for name in table]
            shares = [
                [
                    Markup(
                        "<b>{:+.2f}</b>" if _STRONG <= abs(one) < 1.0 - 1e-9 else "{:+.2f}"
                    ).format(one)
                    for one in row
                ]
                for row in (row.values() for row in table.values())
            ]
            rows = [(name, *row) for name, row in zip(names, shares, strict=True)]
            caption = f"Correlations of the {part}'s parameters"
            parts.append(page.table(caption, ("", *names), rows, numbers=range(1, 1 + len(names))))
    return page.joined(parts)
