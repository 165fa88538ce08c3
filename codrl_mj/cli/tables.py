"""Results as tables for a terminal of 110 columns. They are built here, and printed by `codrl_mj.cli.terminal`."""

import datetime
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.markup import escape
from rich.table import Table

from codrl_mj.cli.look import titled_table
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
    table = titled_table(f"{' or '.join(map(str, counts))} episodes a row: means [95 % bootstrap interval]")
    table.add_column("policy", overflow="fold")
    shown = {
        name: as_text
        for name, (header, as_text) in _TELLING.items()
        if any(getattr(evaluation, name) is not None for evaluation in evaluations.values())
    }
    for name in shown:
        table.add_column(_TELLING[name][0], justify="right", no_wrap=True)
    for title, evaluation in evaluations.items():
        values = {name: getattr(evaluation, name) for name in shown}
        texts = [_NOTHING if value is None else shown[name](value) for name, value in values.items()]
        table.add_row(*map(escape, (title, *texts)))
    return table


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
    table = titled_table(f"motors of {title}: energies of an episode")
    table.add_column("motor", overflow="fold")
    for name in shown:
        table.add_column(_OF_MOTORS[name], justify="right", no_wrap=True)
    for motor, measures in evaluation.motors.items():
        table.add_row(*map(escape, (motor, *(_text(measures[name]) for name in shown))))
    return table


def _details(evaluations: Mapping[str, Evaluation]) -> Table:
    """A column for each evaluation, a row for each measure that one of them has and `_compact` does not show whole."""
    table = titled_table("mean [95 % interval], or median [quartiles]")
    table.add_column("measure", no_wrap=True)
    for title in evaluations:
        table.add_column(escape(title), justify="right", overflow="fold")
    ends = [f"{e.terminated} task, {e.episodes - e.terminated} time limit" for e in evaluations.values()]
    table.add_row("episodes ended by", *ends)
    for name, field in MEASURES.items():
        values = [getattr(evaluation, name) for evaluation in evaluations.values()]
        spread = any(isinstance(value, Interval | Quartiles) for value in values)
        if name in _SHOWN or (name in _TELLING and not spread) or all(value is None for value in values):
            continue
        scale, unit = (100.0, "%") if field.metadata["unit"] == "share" else (1.0, field.metadata["unit"])
        label = f"{field.metadata['label']} [{unit.replace('*', '·')}]"
        table.add_row(*map(escape, (label, *(_text(value, scale) for value in values))))
    return table


def _text(value: Any, scale: float = 1.0) -> str:
    if value is None:
        return _NOTHING
    if isinstance(value, Interval | Quartiles):
        return "{} [{}, {}]".format(*(_text(number, scale) for number in value))
    number = scale * value
    return f"{number:.3g}" if abs(number) < 1000 else f"{number:.0f}"


def run_table(runs: Sequence[RunSummary]) -> Table:
    """A row for each run."""
    table = titled_table(f"{len(runs)} run{'' if len(runs) == 1 else 's'}")
    for header in ("run", "task", "agent", "actuator"):
        table.add_column(header, overflow="fold")
    for header in ("seed", "steps", "state", "training\nreturn", "evaluated\nreturn", "modified"):
        table.add_column(header, justify="right", no_wrap=True)
    for run in runs:
        known = [_NOTHING if value is None else str(value) for value in (run.task, run.agent, run.actuator, run.seed)]
        returns = [_NOTHING if value is None else f"{value:.1f}" for value in (run.mean_return, run.evaluation_return)]
        table.add_row(
            *map(escape, (run.name, *known, _steps(run))),
            {"finished": "[green]finished", "unfinished": "[yellow]unfinished", "damaged": "[red]damaged"}[run.state],
            *returns,
            _NOTHING if run.modified is None else f"{datetime.datetime.fromtimestamp(run.modified):%m-%d %H:%M}",
        )
    return table


def _steps(run: RunSummary) -> str:
    if run.steps is None:
        return _NOTHING
    share = f" ({run.steps / run.total_steps:.0%})" if run.state == "unfinished" and run.total_steps else ""
    return f"{run.steps:,}{share}"


def comparison_tables(comparison: Comparison) -> list[Table]:
    """What differs in the configuration, and the results: a column for each run, at most some at a time."""
    count = len(comparison.names)
    return [
        _side_by_side(title, comparison.names, rows, range(begin, min(begin + _COLUMNS, count)))
        for begin in range(0, count, _COLUMNS)
        for title, rows in (("settings that differ", comparison.configuration), ("results", comparison.results))
        if rows
    ]


def _side_by_side(title: str, names: Sequence[str], rows: Mapping[str, Sequence[Any]], columns: Sequence[int]) -> Table:
    table = titled_table(title)
    table.add_column("", overflow="fold")
    for column in columns:
        table.add_column(escape(names[column]), justify="right", overflow="fold")
    for label, values in rows.items():
        table.add_row(*map(escape, (label, *(_any_text(values[column]) for column in columns))))
    return table


def _any_text(value: Any) -> str:
    """Text of whatever JSON can hold; of an interval or quartiles, as `_text` has it."""
    if isinstance(value, Mapping) and len(value) == 3 and all(isinstance(one, int | float) for one in value.values()):
        return "{} [{}, {}]".format(*map(_text, value.values()))
    if isinstance(value, float):
        return _text(value)
    return _NOTHING if value is None else str(value)
