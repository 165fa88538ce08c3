"""Results as tables for a terminal of 110 columns."""

import datetime
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from codrl_mj.cli.terminal import console, titled_table
from codrl_mj.evaluation import MEASURES, Evaluation
from codrl_mj.evaluation.measures import Interval, Quartiles
from codrl_mj.runs.summaries import Comparison, RunSummary

_COLUMNS = 3  # evaluations side by side
_NOTHING = "–"


def evaluation_tables(evaluations: Mapping[str, Evaluation], details: bool = True) -> list[Table]:
    """The most telling measures with a row for each evaluation, and then, as details, the others with a column."""
    names = list(evaluations) if details else []
    chunks = [names[begin : begin + _COLUMNS] for begin in range(0, len(names), _COLUMNS)]
    of_motors = [_motors(name, evaluations[name]) for name in names if evaluations[name].motors]
    whole = [_details({name: evaluations[name] for name in chunk}) for chunk in chunks]
    return [_compact(evaluations), *of_motors, *whole]


def print_evaluations(evaluations: Mapping[str, Evaluation], details: bool = True) -> None:
    """Print the most telling measures in one table, a row for each evaluation by its name, and details below it."""
    for table in evaluation_tables(evaluations, details):
        console().print(table)


_TELLING: dict[str, tuple[str, Callable[[Any], str]]] = {
    # field: its column's header, and its value as text
    "success": ("success", lambda value: f"{100 * value.mean:.0f} %"),
    "returns": ("return", lambda value: "{:.1f} [{:.1f}, {:.1f}]".format(*value)),
    "time_to_goal": ("time to\ngoal", lambda value: f"{value.median:.1f} s"),
    "tracking_rms": ("shaft torque\nerror", lambda value: f"{_text(value)} N·m"),
    "saturated_percent": ("saturated", lambda value: f"{value:.1f} %"),
    "peak_voltage": ("peak\n|u|", lambda value: f"{value:.1f} V"),
    "energy_drawn": ("energy\ndrawn", lambda value: f"{_text(value.mean)} J"),
}
_SHOWN = ("returns", "failure")  # whole in the first table, or by what is in it


def _compact(evaluations: Mapping[str, Evaluation]) -> Table:
    """A row for each evaluation; measures that none of them has are left out."""
    counts = sorted({evaluation.episodes for evaluation in evaluations.values()})
    shown = {
        name: column
        for name, column in _TELLING.items()
        if any(getattr(evaluation, name) is not None for evaluation in evaluations.values())
    }
    headers = [header for header, _ in shown.values()]
    rows = []
    for title, evaluation in evaluations.items():
        values = [(getattr(evaluation, name), as_text) for name, (_, as_text) in shown.items()]
        rows.append((title, *(_NOTHING if value is None else as_text(value) for value, as_text in values)))
    title = f"{' or '.join(map(str, counts))} episodes a row: means [95 % bootstrap interval]"
    return titled_table(title, ("policy", *headers), rows, right=headers, whole=headers)


_OF_MOTORS = {
    # measure: its column's header
    "tracking_rms": "shaft torque\nerror [N·m]",
    "tracking_percent": "of desired\n[%]",
    "saturated_percent": "saturated\n[%]",
    "rms_current": "current,\nrms [A]",
    "peak_current": "peak\n[A]",
    "peak_speed": "shaft speed,\npeak [rad/s]",
    "peak_temperature": "hottest\n[°C]",
    "copper_loss": "heat\n[J]",
    "energy_drawn": "drawn\n[J]",
    "mechanical_work": "work\n[J]",
}


def _motors(title: str, evaluation: Evaluation) -> Table:
    """A row for each of several motors; measures that none of them has are left out."""
    shown = [name for name in _OF_MOTORS if any(one.get(name) is not None for one in evaluation.motors.values())]
    headers = [_OF_MOTORS[name] for name in shown]
    rows = [(motor, *(_text(found[name]) for name in shown)) for motor, found in evaluation.motors.items()]
    return titled_table(
        f"motors of {title}: energies of an episode", ("motor", *headers), rows, right=headers, whole=headers
    )


def _details(evaluations: Mapping[str, Evaluation]) -> Table:
    """A column for each evaluation, a row for each measure that one of them has and `_compact` does not show whole."""
    ends = [f"{e.terminated} task, {e.episodes - e.terminated} time limit" for e in evaluations.values()]
    rows = [("episodes ended by", *ends)]
    for name, field in MEASURES.items():
        values = [getattr(evaluation, name) for evaluation in evaluations.values()]
        spread = any(isinstance(value, Interval | Quartiles) for value in values)
        if name in _SHOWN or (name in _TELLING and not spread) or all(value is None for value in values):
            continue
        scale, unit = (100.0, "%") if field.metadata["unit"] == "share" else (1.0, field.metadata["unit"])
        label = f"{field.metadata['label']} [{unit.replace('*', '·')}]"
        rows.append((label, *(_text(value, scale) for value in values)))
    title = "mean [95 % interval], or median [quartiles]"
    return titled_table(title, ("measure", *evaluations), rows, right=list(evaluations), whole=("measure",))


def _text(value: Any, scale: float = 1.0) -> str:
    if value is None:
        return _NOTHING
    if isinstance(value, Interval | Quartiles):
        return "{} [{}, {}]".format(*(_text(number, scale) for number in value))
    number = scale * value
    return f"{number:.3g}" if abs(number) < 1000 else f"{number:.0f}"


_STATES = {"finished": "green", "unfinished": "yellow", "damaged": "red"}
_OF_RUNS = "seed", "steps", "state", "training\nreturn", "evaluated\nreturn", "modified"


def run_table(runs: Sequence[RunSummary]) -> Table:
    """A row for each run."""
    rows: list[Any] = []
    for run in runs:
        known = [_NOTHING if value is None else str(value) for value in (run.task, run.agent, run.actuator, run.seed)]
        returns = [_NOTHING if value is None else f"{value:.1f}" for value in (run.mean_return, run.evaluation_return)]
        share = (
            f" ({run.steps / run.total_steps:.0%})"
            if run.state == "unfinished" and run.steps is not None and run.total_steps
            else ""
        )
        steps = _NOTHING if run.steps is None else f"{run.steps:,}{share}"
        time = _NOTHING if run.modified is None else f"{datetime.datetime.fromtimestamp(run.modified):%m-%d %H:%M}"
        rows.append((run.name, *known, steps, Text(run.state, _STATES[run.state]), *returns, time))
    title = f"{len(runs)} run{'' if len(runs) == 1 else 's'}"
    return titled_table(title, ("run", "task", "agent", "actuator", *_OF_RUNS), rows, right=_OF_RUNS, whole=_OF_RUNS)


def comparison_tables(comparison: Comparison) -> list[Table]:
    """What differs in the configuration, and the results: a column for each run, at most some at a time."""
    found = []
    for begin in range(0, len(comparison.names), _COLUMNS):
        chunk = slice(begin, begin + _COLUMNS)
        names = comparison.names[chunk]
        for title, content in (("settings that differ", comparison.configuration), ("results", comparison.results)):
            if content:
                rows = [(label, *map(_any_text, values[chunk])) for label, values in content.items()]
                found.append(titled_table(title, ("", *names), rows, right=names))
    return found


def _any_text(value: Any) -> str:
    """Text of whatever JSON can hold; of an interval or quartiles, as `_text` has it."""
    if isinstance(value, Mapping) and len(value) == 3 and all(isinstance(one, int | float) for one in value.values()):
        return "{} [{}, {}]".format(*map(_text, value.values()))
    if isinstance(value, float):
        return _text(value)
    return _NOTHING if value is None else str(value)
