"""`codrl-mj evaluate`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.cli.environments import environment
from codrl_mj.cli.fields import AS_TRAINED, ActuatorName, with_environment
from codrl_mj.cli.subject import Source


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Measure a trained policy on any actuator: return, success, torque tracking, voltage, energy, heat.

    Of several motors there is a second table, with what each of them did. Several policies have a row each, every one
    in the environment of its own training.

    Example: codrl-mj evaluate runs/cartpole-ppo-ideal-0 --actuator weaker --episodes 100
    """

    policies: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(
            metavar="POLICY",
            help="Run folders; or folders with a policy alone, or Stable-Baselines3 zips (see --trust).",
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

    for_line = classmethod(with_environment)

    def run(self: Any) -> int:
        """Evaluate and print a table."""
        from codrl_mj.cli.tables import print_evaluations
        from codrl_mj.cli.terminal import progress_bar
        from codrl_mj.evaluation import evaluate
        from codrl_mj.runs.layout import told_apart

        if not self.policies:
            raise ValueError("POLICY: none was given; name a run folder or more, such as runs/cartpole-ppo-ideal-0")
        to_do, found = {}, {}
        for path, name in zip(self.policies, told_apart(self.policies), strict=True):
            verb = self if len(self.policies) == 1 else self._alone(path)
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
        if self.out is not None:
            from codrl_mj.runs.files import write_json

            mappings = {name: one.as_mapping() for name, one in found.items()}
            write_json(self.out, mappings if len(mappings) > 1 else mappings.popitem()[1])
            print(f"wrote {self.out}")
        return 0

    def _alone(self: Any, path: Path) -> Any:
        """The command line with one policy: its run has the defaults of the flags."""
        line = [word for word in self.line if Path(word) == path or Path(word) not in self.policies]
        return tyro.cli(with_environment(Evaluate, line), args=line)
