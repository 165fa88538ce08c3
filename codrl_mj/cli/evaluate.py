"""`codrl-mj evaluate`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.cli.environments import environment
from codrl_mj.cli.fields import AS_TRAINED, ActuatorName
from codrl_mj.cli.subject import Source, title_of


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Measure a trained policy on any actuator: return, success, torque tracking, voltage, energy, heat.

    Of several motors there is a second table, with what each of them did.

    Example: codrl-mj evaluate runs/cartpole-ppo-ideal-0 --actuator weaker --episodes 100
    """

    policy: Annotated[
        tyro.conf.Positional[Path],
        tyro.conf.arg(help="Run folder; or a folder with a policy alone, or a Stable-Baselines3 zip (see --trust)."),
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
    """JSON file for the result."""

    def run(self: Any) -> int:
        """Evaluate and print a table."""
        from codrl_mj.cli.terminal import print_evaluations, progress_bar
        from codrl_mj.evaluation import evaluate

        subject = self.source.load(self.policy)
        env = environment(self, subject.env.task, self.actuator_name, subject.env)
        subject.check_interface(env)
        with progress_bar("{task.completed}/{task.total} episodes") as bar:
            row = bar.add_task("evaluating", total=self.episodes)
            evaluation = evaluate(
                subject.policy,
                env,
                self.episodes,
                self.seed,
                not self.stochastic,
                on_step=lambda _, ended: bar.update(row, completed=ended),
            )
        print_evaluations({title_of(self.policy, env): evaluation})
        if self.out is not None:
            from codrl_mj.runs.files import write_json

            write_json(self.out, evaluation.as_mapping())
            print(f"wrote {self.out}")
        return 0
