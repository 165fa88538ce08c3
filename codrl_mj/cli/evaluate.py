"""`codrl-mj evaluate`, and tables of its measures for terminals of 80 columns or more."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.cli.environments import (
    AS_TRAINED,
    ActuatorName,
    EnvironmentVerb,
    build_env_config,
    with_environment_flags,
)
from codrl_mj.cli.parsing import AsJson, Output
from codrl_mj.cli.subject import Source
from codrl_mj.cli.terminal import format_number, print_table, progress_bar
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import MEASURES, Evaluation, evaluate
from codrl_mj.evaluation.measures import Interval, Quartiles
from codrl_mj.runs import unique_names
from codrl_mj.runs.files import write_json
from codrl_mj.runs.policies import Policy


@dataclasses.dataclass(frozen=True)
class Evaluate(EnvironmentVerb):
    """Measure a policy on any actuator: return, success, torque tracking, voltage, energy, heat.

    If there are several motors, a second table lists the measures of each. If you name several
    policies, each has its own row and is evaluated in the environment of its training.

    Example: codrl-mj evaluate runs/cartpole-ppo-ideal-0 --actuator weaker --episodes 100
    """

    policies: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(
            metavar="POLICY",
            help=(
                "Run folders; or folders with only a policy, or Stable-Baselines3 zips (see"
                " --trust)."
            ),
        ),
    ]
    source: tyro.conf.OmitArgPrefixes[Source] = Source()
    actuator_name: ActuatorName = AS_TRAINED
    episodes: int = 50
    """Number of episodes, each with a different seed."""
    seed: int = 0
    """Seed of the first episode; each further episode uses the next integer."""
    stochastic: bool = False
    """Sample the actions instead of taking the most likely ones."""
    out: Path | None = None
    """JSON file for the result; for several policies, it contains all results by name."""
    as_json: AsJson = False

    def run(self) -> Output:
        """Evaluate the policies and print tables."""
        if not self.policies:
            raise ValueError(
                "POLICY: none was given; name one or more run folders, such as"
                " runs/cartpole-ppo-ideal-0"
            )
        jobs: dict[str, tuple[Policy, EnvConfig]] = {}
        evaluations: dict[str, Evaluation] = {}
        for path, name in zip(self.policies, unique_names(self.policies), strict=True):
            verb = self
            if len(self.policies) > 1:
                # The defaults of the flags come from the first run of a line, so the line is parsed
                # again for each run, without the other runs.
                line = [
                    word
                    for word in self.line
                    if Path(word) == path or Path(word) not in self.policies
                ]
                verb = tyro.cli(with_environment_flags(Evaluate, line), args=line)
            subject = verb.source.load(path)
            env = build_env_config(verb, subject.env.task, verb.actuator_name, subject.env)
            subject.check_interface(env)
            jobs[f"{name} on {env.actuator_label}"] = subject.policy, env
        with progress_bar("{task.completed}/{task.total} episodes") as bar:
            for name, (policy, env) in jobs.items():
                row = bar.add_task("evaluating" if len(jobs) == 1 else name, total=self.episodes)
                evaluations[name] = evaluate(
                    policy,
                    env,
                    self.episodes,
                    self.seed,
                    not self.stochastic,
                    on_step=lambda _, ended, row=row: bar.update(row, completed=ended),  # type: ignore[misc]
                )
        print_evaluations(evaluations)
        mappings = {name: evaluation.as_mapping() for name, evaluation in evaluations.items()}
        content = mappings if len(mappings) > 1 else mappings.popitem()[1]
        if self.out is not None:
            write_json(self.out, content)
            print(f"wrote {self.out}")
        return 0, content


def print_evaluations(evaluations: Mapping[str, Evaluation], details: bool = True) -> None:
    """Print the main measures in one table, with a row for each evaluation, and details below it.

    Measures that no evaluation has are left out.
    """
    counts = sorted({evaluation.episodes for evaluation in evaluations.values()})
    _print_measures(
        f"{' or '.join(map(str, counts))} episodes per row: means [95 % bootstrap interval]",
        "policy",
        {title: vars(evaluation) for title, evaluation in evaluations.items()},
        _MAIN_COLUMNS,
    )
    if not details:
        return
    for title, evaluation in evaluations.items():
        if evaluation.motors:
            _print_measures(
                f"motors of {title}: energies of an episode",
                "motor",
                evaluation.motors,
                _MOTOR_COLUMNS,
            )
    names = list(evaluations)
    # Three columns of evaluations fit into 80 characters.
    for begin in range(0, len(names), 3):
        _print_details({name: evaluations[name] for name in names[begin : begin + 3]})


# Each measure has the type of its field in `Evaluation`.
MeasureValue = Any
"""Value of a measure."""
Columns = Mapping[str, tuple[str, Callable[[MeasureValue], str]]]
"""Measure -> header of its column, and a function that formats its value."""


def _print_measures(
    title: str, row_header: str, rows: Mapping[str, Mapping[str, MeasureValue]], columns: Columns
) -> None:
    """Print a row for each entry, with a column for each measure that at least one entry has."""
    shown_columns = {
        name: columns[name]
        for name in columns
        if any(row.get(name) is not None for row in rows.values())
    }
    headers = [header for header, _ in shown_columns.values()]
    cells = [
        (
            label,
            *(
                "–" if row[name] is None else as_text(row[name])
                for name, (_, as_text) in shown_columns.items()
            ),
        )
        for label, row in rows.items()
    ]
    print_table(title, (row_header, *headers), cells, right=headers, whole=headers)


def _print_details(evaluations: Mapping[str, Evaluation]) -> None:
    """Print a column for each evaluation, and a row for each measure.

    Measures that the first table shows completely, and those that no evaluation has, are left out.
    """
    endings = [
        f"{e.terminated} task, {e.episodes - e.terminated} time limit" for e in evaluations.values()
    ]
    rows = [("episodes ended by", *endings)]
    for name, field in MEASURES.items():
        values = [getattr(evaluation, name) for evaluation in evaluations.values()]
        has_interval = any(isinstance(value, Interval | Quartiles) for value in values)
        if (
            name in _NOT_IN_DETAILS
            or (name in _MAIN_COLUMNS and not has_interval)
            or all(value is None for value in values)
        ):
            continue
        unit = field.metadata["unit"]
        if unit == "share":
            unit = "%"
            values = [value and tuple(100.0 * bound for bound in value) for value in values]
        rows.append(
            (f"{field.metadata['label']} [{unit.replace('*', '·')}]", *map(format_number, values))
        )
    title = "mean [95 % interval], or median [quartiles]"
    print_table(title, ("measure", *evaluations), rows, right=list(evaluations), whole=("measure",))


_MAIN_COLUMNS: Columns = {
    "success": ("success", lambda value: f"{100 * value.mean:.0f} %"),
    "returns": ("return", lambda value: "{:.1f} [{:.1f}, {:.1f}]".format(*value)),
    "time_to_goal": ("time to\ngoal", lambda value: f"{value.median:.1f} s"),
    "tracking_rms": ("shaft\ntorque\nerror", lambda value: f"{format_number(value)} N·m"),
    "saturated_percent": ("satu-\nrated", lambda value: f"{value:.1f} %"),
    "peak_voltage": ("peak\n|u|", lambda value: f"{value:.1f} V"),
    "energy_drawn": ("energy\ndrawn", lambda value: f"{format_number(value.mean)} J"),
}
# The first table shows the returns with their interval; failure is the complement of success.
_NOT_IN_DETAILS = ("returns", "failure")
_MOTOR_COLUMNS: Columns = {
    name: (head, format_number)
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
