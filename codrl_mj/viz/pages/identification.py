"""Page of an identification: fits, residuals, intervals, correlations, and advice for the bench."""

import itertools
import math
from pathlib import Path

import numpy as np
from markupsafe import Markup

from codrl_mj.identify.log import SIGNALS
from codrl_mj.identify.result import USABLE, Identified, Trace
from codrl_mj.identify.uncertainty import CAUSES
from codrl_mj.plots import Curve, Plot
from codrl_mj.viz.pages import page

_MAX_LAGS = 400
_STRONG_CORRELATION = 0.9
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
    "position_gain": "hang a heavier pendulum on it, and hold it at several angles",
    "stall_torque": "command large steps, so that the duty reaches its limit, or log the duty",
    "duty_gain": "log the duty (Feetech: Present Load, Dynamixel: Present PWM)",
    "damping": "command several speeds up to the highest, in both directions",
    "armature": "command steps, and sweep a sine up to the servo's bandwidth",
    "command_delay": "log more often, and command steps",
    "zero": "swing through the middle, or give --known zero=…",
    "stribeck_speed": "creep: log speeds from standstill to where friction is least",
}


def identification_page(result: Identified, out: Path) -> Path:
    """Write the page of an identification."""
    winding = [trace for trace in result.traces if trace.part == "winding"]
    shaft = [trace for trace in result.traces if trace.part == "shaft"]
    predicted = [prediction.trace for prediction in result.held_out if prediction.trace is not None]
    fits = (
        [page.heading("Winding: the current under the logged voltage"), *map(_fit_plots, winding)]
        if winding
        else []
    )
    fits += [page.heading("Shaft, piece by piece"), *map(_fit_plots, shaft)] if shaft else []
    sections = [
        page.Section("parameters", "Parameters", _parameters(result)),
        page.Section("better", "Advice for the next experiment", _advice(result)),
        page.Section("errors", "Errors of the simulation", _errors(result)),
        page.Section("fits", "Fitted logs", page.join(fits)),
        page.Section("held-out", "Predicted logs", page.join(map(_fit_plots, predicted))),
        page.Section("correlations", "Correlated parameters", _correlations(result)),
    ]
    title = f"Identified from {', '.join(result.logs)}"
    return page.write(out, page.page(title, "A motor from its bench logs", _top(result), sections))


def _top(result: Identified) -> Markup:
    problem = result.problem()
    input_text = f", driven by its {result.driven_by}" if result.driven_by else ""
    num_usable = sum(estimate.status in USABLE for estimate in result.estimates)
    delay_texts = [
        f"the input of the {part} is late by {rows:g} row{'s' * (abs(rows) != 1)}, which the"
        " fit accounts for"
        for part, rows in result.delays.items()
        if rows
    ]
    summary = (
        f"{num_usable} of {len(result.estimates)} parameters are reliable. Rig:"
        f" {result.rig}{input_text}; friction: {result.friction}"
        + "".join(
            f"; {text}"
            for text in (result.friction_reason, result.supply_text, result.base_text)
            if text
        )
    )
    usable = "usable as an actuator" if problem is None else "not to be used as an actuator"
    parts = [
        page.mark_verdict(problem is None, usable, "p", "verdict"),
        page.paragraph("; ".join([summary, *delay_texts]) + ".", "lead"),
    ]
    parts += [page.note(problem, bad=True)] if problem is not None else []
    return page.join((*parts, *map(page.note, result.warnings)))


def _parameters(result: Identified) -> Markup:
    rows = []
    for estimate in result.estimates:
        interval = (
            ""
            if estimate.status == "given"
            else f"{page.format_number(estimate.low)} to {page.format_number(estimate.high)}"
        )
        half_width = (
            50.0 * (estimate.high - estimate.low) / abs(estimate.value)
            if estimate.value
            else math.nan
        )
        main_cause = (
            max(estimate.causes, key=lambda cause: estimate.causes[cause])
            if estimate.causes
            else ""
        )
        is_usable = estimate.status in USABLE
        share = f"{half_width:.2g} %" if interval and math.isfinite(half_width) else ""
        unit, name = page.format_unit(estimate.unit), estimate.name.replace("_", " ")
        cells = (
            name,
            page.format_number(estimate.value),
            interval,
            share,
            unit,
            page.mark_verdict(is_usable, estimate.status),
            estimate.why,
            CAUSES.get(main_cause, ""),
        )
        rows.append(cells)
    columns = (
        "parameter",
        "value",
        "95 % interval",
        "half width",
        "unit",
        "status",
        "reason",
        "main cause",
    )
    failed = (
        index for index, estimate in enumerate(result.estimates) if estimate.status not in USABLE
    )
    return page.table("Parameters with 95 % intervals", columns, rows, (1, 2, 3), True, failed)


def _advice(result: Identified) -> Markup:
    texts = [
        Markup("<b>{}</b> is {}: {}.").format(
            estimate.name.replace("_", " "), estimate.status, _ADVICE[estimate.name]
        )
        for estimate in result.estimates
        if estimate.status not in ("identified", "given") and estimate.name in _ADVICE
    ]
    pair_text = Markup(
        "<b>{}</b> and <b>{}</b> cannot be separated (correlation {:+.2f}): give one of them with"
        " --known, or use an excitation on which they act differently."
    )
    texts += [
        pair_text.format(
            name.replace("_", " "), other_name.replace("_", " "), table[name][other_name]
        )
        for table in result.correlations.values()
        for name, other_name in itertools.combinations(table, 2)
        if abs(table[name][other_name]) >= _STRONG_CORRELATION
    ]
    if not result.held_out and result.driven_by:
        texts.append(
            Markup(
                "No log was held out: pass one with --holdout, to see how well the parameters"
                " predict it."
            )
        )
    if len(result.logs) < 2:
        texts.append(Markup("A single log: a second one shows differences from day to day."))
    if not texts:
        return page.paragraph(
            "No advice: every parameter is identified or given, and a log was held out."
        )
    texts.append(
        Markup("<code>codrl-mj identify plan</code> lists the excitation for each parameter.")
    )
    return Markup("<ul>{}</ul>").format(
        page.join(Markup("<li>{}</li>").format(text) for text in texts)
    )


def _errors(result: Identified) -> Markup:
    rows = []
    for kind, predictions in (("fitted", result.fitted), ("held out", result.held_out)):
        for prediction in predictions:
            errors = (
                page.format_number(error, 3)
                for error in (prediction.open_loop, prediction.closed_loop)
            )
            rows.append(
                (
                    prediction.log,
                    kind,
                    f"{prediction.output} [{SIGNALS[prediction.output]}]",
                    *errors,
                )
            )
    if not rows:
        return Markup()
    columns = ("log", "", "of", "open loop, half a second", "closed loop")
    explanation = page.paragraph(
        "Mean absolute errors. Open loop: the simulation starts at the measured state of the shaft"
        " and runs half a second with the logged input. Closed loop: the whole log, with the"
        " servo's control law, if the log has a command."
    )
    return explanation + page.table("Errors of the simulation", columns, rows, numbers=(3, 4))


def _fit_plots(trace: Trace) -> Markup:
    """Return plots of a log and its simulation, of the residuals and of their autocorrelation.

    The residuals of a good fit are noise, whose autocorrelation is small.
    """
    from scipy.signal import correlate

    unit, label = SIGNALS[trace.output], f"{trace.log}: {trace.output}"
    gaps = trace.starts[1:]
    # The simulation restarts at these rows: NaN interrupts its curve there.
    time, simulated = (np.insert(values, gaps, np.nan) for values in (trace.time, trace.simulated))
    time = np.where(
        np.isnan(time),
        np.interp(np.arange(len(time)), np.flatnonzero(~np.isnan(time)), trace.time),
        time,
    )
    residuals = trace.measured - trace.simulated
    curves = (
        Curve("measured", trace.time, trace.measured, colour=0),
        Curve("simulated", time, simulated, colour=1),
    )
    residual_curve = Curve("residual", time, np.insert(residuals, gaps, np.nan), colour=4)
    centred = residuals - residuals.mean()
    autocorrelation = correlate(centred, centred, method="fft")[len(centred) - 1 :]
    count, bound = min(_MAX_LAGS, len(centred) // 2), 1.96 / math.sqrt(len(centred))
    lags = float(np.median(np.diff(trace.time))) * np.arange(count + 1)
    autocorrelation_curves = (
        Curve(
            "autocorrelation",
            lags,
            autocorrelation[: count + 1] / max(autocorrelation[0], 1e-300),
            colour=3,
        ),
        Curve("95 % of noise", lags[[0, -1]], np.full(2, bound), reference=True),
        Curve("95 % of noise, below", lags[[0, -1]], np.full(2, -bound), reference=True),
    )
    return page.plots(
        (
            Plot(label, "time [s]", f"{trace.output} [{unit}]", curves),
            Plot(
                f"{label}, residuals",
                "time [s]",
                f"measured minus simulated [{unit}]",
                (residual_curve,),
            ),
            Plot(
                f"{label}, autocorrelation of residuals", "lag [s]", "share", autocorrelation_curves
            ),
        )
    )


def _correlations(result: Identified) -> Markup:
    parts = []
    for part, table in result.correlations.items():
        if len(table) > 1:
            names = [name.replace("_", " ") for name in table]
            cells = [
                [
                    Markup(
                        "<b>{:+.2f}</b>"
                        if _STRONG_CORRELATION <= abs(correlation) < 1.0 - 1e-9
                        else "{:+.2f}"
                    ).format(correlation)
                    for correlation in row
                ]
                for row in (row.values() for row in table.values())
            ]
            rows = [(name, *row) for name, row in zip(names, cells, strict=True)]
            caption = f"Correlations of the {part}'s parameters"
            parts.append(page.table(caption, ("", *names), rows, numbers=range(1, 1 + len(names))))
    return page.join(parts)
