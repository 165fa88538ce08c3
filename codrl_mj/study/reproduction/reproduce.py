"""The grid of the paper's experiments, and what its runs say: from run folders alone, whoever computed them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from codrl_mj.fields import check, integer
from codrl_mj.study.grid import check_chosen
from codrl_mj.study.reproduction.arms import ARMS, TASKS
from codrl_mj.study.reproduction.claims import CLAIMS, Claim
from codrl_mj.study.reproduction.series import Series, read_series
from codrl_mj.study.reproduction.value_iteration import DISCOUNTS, Mesh, Model, Optimum, optimum, values_over
from codrl_mj.study.reproduction.value_iteration import TASK as VALUE_TASK
from codrl_mj.study.reproduction.verdicts import Verdict
from codrl_mj.study.trials import Collected, Grid

VALUE_DISCOUNTS = tuple(1 - 0.2 * 0.8**step for step in range(24))
"""Discount factors of the curve of values, from 0.8 to 0.999."""


@dataclasses.dataclass(frozen=True)
class Reproduction:
    """What is to be done again, and where.

    Raises:
        ValueError: an unknown task (the nearest known one is suggested), or a number below 1.
    """

    root: Path = Path("runs/paper")
    """Folder of the run folders."""
    tasks: tuple[str, ...] = TASKS
    """Tasks."""
    seeds: int = integer(5, least=1)
    """Runs of every arm, >= 1, with seeds from 0."""
    sarsa_seeds: int = integer(30, least=1)
    """Runs of every arm of SARSA, >= 1, which takes seconds."""
    episodes: int | None = integer(None, least=1)
    """Training episodes, >= 1, for trying things out; None: the paper's budgets."""
    test_episodes: int = integer(100, least=1)
    """Test episodes of every policy, >= 1."""
    mesh: Mesh = Mesh()
    """Of value iteration."""

    def __post_init__(self) -> None:
        """Validate."""
        check_chosen("tasks", self.tasks, TASKS)
        check(self)

    @property
    def grid(self) -> Grid:
        """The trainings and their tests."""
        arms = [arm for arm in ARMS if arm.task in self.tasks]
        if self.episodes is not None:
            arms = [arm.cut_off(self.episodes) for arm in arms]
        return Grid(
            self.root,
            tuple(trial for arm in arms for trial in arm.trials.values()),
            lambda arm: range(self.sarsa_seeds if arm.config.agent.name == "sarsa" else self.seeds),
            self.test_episodes,
        )


@dataclasses.dataclass(frozen=True)
class Findings:
    """What there is, and what it says."""

    plan: Reproduction
    """What was to be done."""
    found: Collected
    """What is computed."""
    series: Mapping[str, Series]
    """The runs of every arm, by its name."""
    claims: Sequence[tuple[Claim, Verdict]]
    """Every claim and its verdict."""
    optima: Sequence[Optimum]
    """The continuous mountain car's best policies at `DISCOUNTS`; none without that task."""
    values: Mapping[float, float]
    """Discount factor -> value of its start; empty without that task."""

    @property
    def missing(self) -> dict[str, list[int]]:
        """Arm -> seeds that are wanted and not finished and tested."""
        seeds_of = self.found.grid.seeds_of
        missing = {
            name: [seed for seed in seeds_of(one.arm) if seed not in one.runs] for name, one in self.series.items()
        }
        return {name: seeds for name, seeds in missing.items() if seeds}


def gather(plan: Reproduction) -> Findings:
    """Read what is finished, and judge every claim by it; runs nothing but value iteration.

    Raises:
        ValueError: a file of a finished run is damaged.
    """
    found = plan.grid.collect()
    series = {arm.name: read_series(arm, found) for arm in ARMS if arm.task in plan.tasks}
    judged = [(claim, claim.judge(series)) for claim in CLAIMS if claim.task in plan.tasks]
    if VALUE_TASK not in plan.tasks:
        return Findings(plan, found, series, judged, [], {})
    model = Model(plan.mesh)
    optima = [optimum(model, discount) for discount in DISCOUNTS]
    return Findings(plan, found, series, judged, optima, values_over(model, VALUE_DISCOUNTS))
