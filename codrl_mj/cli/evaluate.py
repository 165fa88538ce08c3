"""`codrl-mj evaluate`, and the tables of what is measured, for a terminal of 80 columns or more."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.cli.environments import AS_TRAINED, ActuatorName, environment, with_environment
from codrl_mj.cli.parsing import AsJson
from codrl_mj.cli.subject import Source
from codrl_mj.cli.terminal import number, print_table, progress_bar
from codrl_mj.evaluation import MEASURES, Evaluation, evaluate
from codrl_mj.evaluation.measures import Interval, Quartiles
from codrl_mj.runs import unique_names
from codrl_mj.runs.files import write_json


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Measure a trained policy on any actuator: return, success, torque tracking, voltage, energy, heat.

    Of several motors there is a second table, with what each of them did. Several policies have a
    row each, every one in the environment of its own training.

    Example: codrl-mj evaluate runs/cartpole-ppo-ideal-0 --actuator weaker --episodes 100
    """

    policies: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(
            metavar="POLICY",
            help=(
                "Run folders; or folders with a policy alone, or Stable-Baselines3 zips (see"
                " --trust)."
            ),
        ),
    ]
    source: tyro.conf.OmitArgPrefixes[Source] = Source()
    actuator_name: ActuatorName = AS_TRAINED
    episodes: int = 50
    """Episodes, each from its own seed."""
    seed: int = 0
    """Seed of the first episode; the others count up from it."""
    stochastic: bool = False
    """Sample the actions instead of taking the most likely ones."""
    out: Path | None = None
    """JSON file for the result; of several policies for all of them, by their names."""
    as_json: AsJson = False

    for_line = classmethod(with_environment)

    def run(self: Any) -> tuple[int, Any]:
        """Evaluate and print tables."""
        if not self.policies:
            raise ValueError(
                "POLICY: none was given; name a run folder or more, such as"
                " runs/cartpole-ppo-ideal-0"
            )
        to_do, found = {}, {}
        for path, name in zip(self.policies, unique_names(self.policies), strict=True):
            verb = self
            if len(self.policies) > 1:  # each run has the defaults of its flags
                line = [
                    word
                    for word in self.line
                    if Path(word) == path or Path(word) not in self.policies
                ]
                verb = tyro.cli(with_environment(Evaluate, line), args=line)
            subject = verb.source.load(path)
            env = environment(verb, subject.env.task, verb.actuator_name, subject.env)
            subject.check_interface(env)
            to_do[f"{name} on {env.through}"] = subject.policy, env
        with progress_bar("{task.completed}/{task.total} episodes") as bar:
            for name, (policy, env) in to_do.items():
                row = bar.add_task("evaluating" if len(to_do) == 1 else name, total=self.episodes)
                found[name] = evaluate(
                    policy,
                    env,
                    self.episodes,
                    self.seed,
                    not self.stochastic,
                    on_step=lambda _, ended, row=row: bar.update(row, completed=ended),  # type: ignore[misc]
                )
        print_evaluations(found)
        mappings = {name: one.as_mapping() for name, one in found.items()}
        content = mappings if len(mappings) > 1 else mappings.popitem()[1]
        if self.out is not None:
            write_json(self.out, content)
            print(f"wrote {self.out}")
        return 0, content


def print_evaluations(evaluations: Mapping[str, Evaluation], details: bool = True) -> None:
    """Print the most telling measures in one table, a row for each evaluation by its name, and details below it.

    Measures that none of them has are left out.
    """
    counts = sorted({evaluation.episodes for evaluation in evaluations.values()})
    _print_measures(
        f"{' or '.join(map(str, counts))} episodes a row: means [95 % bootstrap interval]",
        "policy",
        {title: vars(evaluation) for title, evaluation in evaluations.items()},
        _TELLING,
    )
    if not details:
        return
    for title, evaluation in evaluations.items():
        if evaluation.motors:
            _print_measures(
                f"motors of {title}: energies of an episode", "motor", evaluation.motors, _OF_MOTORS
            )
    names = list(evaluations)
    for begin in range(0, len(names), 3):
        _print_details({name: evaluations[name] for name in names[begin : begin + 3]})


Columns = Mapping[str, tuple[str, Callable[[Any], str]]]
"""Measure -> its column's header, and its value as text."""


def _print_measures(
    title: str, what: str, rows: Mapping[str, Mapping[str, Any]], columns: Columns
) -> None:
    """A row for each of some measured things, a column for each measure that one of them has."""
    shown = {
        name: columns[name]
        for name in columns
        if any(row.get(name) is not None for row in rows.values())
    }
    heads = [head for head, _ in shown.values()]
    cells = [
        (
            label,
            *(
                "–" if row[name] is None else as_text(row[name])
                for name, (_, as_text) in shown.items()
            ),
        )
        for label, row in rows.items()
    ]
    print_table(title, (what, *heads), cells, right=heads, whole=heads)


def _print_details(evaluations: Mapping[str, Evaluation]) -> None:
    """A column for each evaluation, a row for each measure that one of them has and that is not whole in the first."""
    ends = [
        f"{e.terminated} task, {e.episodes - e.terminated} time limit" for e in evaluations.values()
    ]
    rows = [("episodes ended by", *ends)]
    for name, field in MEASURES.items():
        values = [getattr(evaluation, name) for evaluation in evaluations.values()]
        spread = any(isinstance(value, Interval | Quartiles) for value in values)
        if (
            name in _SHOWN
            or (name in _TELLING and not spread)
            or all(value is None for value in values)
        ):
            continue
        unit = field.metadata["unit"]
        if unit == "share":
            unit, values = "%", [value and tuple(100.0 * one for one in value) for value in values]
        rows.append((f"{field.metadata['label']} [{unit.replace('*', '·')}]", *map(number, values)))
    title = "mean [95 % interval], or median [quartiles]"
    print_table(title, ("measure", *evaluations), rows, right=list(evaluations), whole=("measure",))


_TELLING: Columns = {
    "success": ("success", lambda value: f"{100 * value.mean:.0f} %"),
    "returns": ("return", lambda value: "{:.1f} [{:.1f}, {:.1f}]".format(*value)),
    "time_to_goal": ("time to\ngoal", lambda value: f"{value.median:.1f} s"),
    "tracking_rms": ("shaft\ntorque\nerror", lambda value: f"{number(value)} N·m"),
    "saturated_percent": ("satu-\nrated", lambda value: f"{value:.1f} %"),
    "peak_voltage": ("peak\n|u|", lambda value: f"{value:.1f} V"),
    "energy_drawn": ("energy\ndrawn", lambda value: f"{number(value.mean)} J"),
}
_SHOWN = ("returns", "failure")  # whole in the first table, or by what is in it
_OF_MOTORS: Columns = {
    name: (head, number)
    for name, head in {
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
    }.items()
}
