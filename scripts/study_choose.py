"""Comparison of training through a motor with choosing among ideal-trained policies on its model.

docs/results/choose_plan.md has the hypotheses and the rules, and was written before the first run.

Example: python scripts/study_choose.py --dry-run, or --only-page to judge the existing rows
"""

import collections
import dataclasses
import functools
import itertools
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from codrl_mj.actuators import Drive
from codrl_mj.actuators.parameters import FieldValue
from codrl_mj.disturbances import Disturbances
from codrl_mj.envs.config import EnvConfig
from codrl_mj.fields import integer
from codrl_mj.runs.files import write_json
from codrl_mj.study import Arm, Grid, Program, StudyResults, Trial, main, pages, questions
from codrl_mj.study.axes import FLOORS, REAL, make_arm, study_env
from codrl_mj.study.trials import FAILURE_MARGIN, RUNS, TOTALS, run_rows
from codrl_mj.tasks import find_task

MOTORS: Mapping[str, Mapping[str, FieldValue]] = {
    **{task: REAL[task]["marginal motor"] for task in ("furuta", "acrobot", "cartpole")},
    "pendulum": {"name": "maxon-ec45-flat-50w", "motor": {"gear_ratio": 20.0}},
}
"""Task -> true motor. Three are the marginal motors of the first study."""
GROUP = 5
"""Policies of a group, from which one is chosen."""
MIN_GROUPS = 12
"""Groups of ideal-trained policies below which nothing is judged: no p-value could be small."""
FIRST_SEED = 100
"""Lowest seed of the trainings; the policies that suggested the hypotheses have seeds 0 to 19."""
CHOOSING_SEED, CHOOSING_EPISODES = 2_000_000, 50
"""First seed and number of the episodes by which a policy is chosen; others judge it."""
ERROR, ERROR_SEED = 0.2, 20
"""Relative error of the wrong motors' numbers, and the seed that draws its signs."""
WRONG_NUMBERS = (
    *("resistance", "inductance", "torque_constant"),
    *("rotor_inertia", "coulomb_friction", "gear_efficiency"),
)
"""Wrong fields of the motor; the back-EMF constant has the error of the torque constant."""
IDEAL_KIND, THROUGH_KIND = "ideal", "through"
IDEAL, MOTOR, WRONG_MOTOR = "ideal", "motor", "wrong motor"
PAGE, FOLDER = "choose.md", "choose"
HYPOTHESES, CHOICES, WRONG_MOTORS = "hypotheses.csv", "choices.csv", "wrong_motors.csv"


class Rule(NamedTuple):
    """Rule that takes one policy of every group."""

    kind: str
    """Training of the policies."""
    name: str
    criterion: str | None
    """Test whose best policy is taken; None: the first policy, as good as a random one."""

    def candidates(self, groups: int) -> list[range]:
        """Return the seeds from which each policy is taken, for a number of ideal groups."""
        seeds = training_seeds(self.kind, groups)
        fives = [seeds[first : first + GROUP] for first in range(0, len(seeds), GROUP)]
        if self != ONE_THROUGH:
            return fives
        # Two policies of every group stand for a single training, which gives as many as there are
        # ideal-trained groups: permutation tests need about equal numbers.
        return [five[index : index + 1] for five in fives for index in range(2)]


AT_RANDOM = Rule(IDEAL_KIND, "random ideal-trained policy", None)
BY_IDEAL = Rule(IDEAL_KIND, "ideal-trained policy chosen on ideal forces", IDEAL)
BY_WRONG_MOTOR = Rule(IDEAL_KIND, "ideal-trained policy chosen on the wrong motor", WRONG_MOTOR)
BY_MOTOR = Rule(IDEAL_KIND, "ideal-trained policy chosen on the true motor", MOTOR)
ONE_THROUGH = Rule(THROUGH_KIND, "random trained-through policy", None)
BEST_THROUGH = Rule(THROUGH_KIND, "trained-through policy chosen on the true motor", MOTOR)
RULES = (AT_RANDOM, BY_IDEAL, BY_WRONG_MOTOR, BY_MOTOR, ONE_THROUGH, BEST_THROUGH)


class Statement(NamedTuple):
    """Statement about all motors; a single verdict `worse` (or `better`) on one refutes it."""

    name: str
    treatment: Rule
    control: Rule
    refuted_by: str = "worse"

    @property
    def text(self) -> str:
        """Text of the statement."""
        relation = "at least as good as" if self.refuted_by == "worse" else "no better than"
        return f"An {self.treatment.name} is {relation} a {self.control.name}"

    def conclude(self, outcomes: Sequence[str]) -> str:
        """Return the verdict from those on all motors."""
        if "not judged" in outcomes:
            return "not judged"
        if self.refuted_by in outcomes:
            return "refuted"
        return "open" if "undecided" in outcomes else "confirmed"


STATEMENTS = (
    Statement("C1", BY_WRONG_MOTOR, ONE_THROUGH),
    Statement("C2", BY_WRONG_MOTOR, BEST_THROUGH),
    Statement("C3", BY_IDEAL, AT_RANDOM, refuted_by="better"),
    Statement("C4", BY_WRONG_MOTOR, AT_RANDOM),
)


def training_seeds(kind: str, groups: int) -> range:
    """Return the seeds of a kind of trainings, for a number of groups of ideal-trained policies."""
    # Trainings are ordered by seed. With every second seed for trainings through the motor, an
    # early end leaves two groups of ideal-trained policies for each of the others.
    return range(FIRST_SEED, FIRST_SEED + GROUP * groups, 1 if kind == IDEAL_KIND else 2)


def model_error(group: int) -> dict[str, float]:
    """Return the factors of a wrong motor's numbers, and `delay`, its delay in policy steps."""
    random = np.random.default_rng([ERROR_SEED, group])
    factors = random.choice((1.0 - ERROR, 1.0 + ERROR), len(WRONG_NUMBERS)).tolist()
    late = {"delay": ERROR * int(random.integers(2))}
    return dict(zip(WRONG_NUMBERS, factors, strict=True)) | late


@functools.cache
def make_env(task: str, test: str, group: int = 0) -> EnvConfig:
    """Return a task's environment: on ideal forces, its motor, or a group's wrong motor."""
    if test == IDEAL:
        return study_env(task)
    env = study_env(task, MOTORS[task])
    if test == MOTOR:
        return env
    assert isinstance(env.actuator, Drive)
    motor, error = env.actuator.motor, model_error(group)
    values = {name: error[name] * getattr(motor, name) for name in WRONG_NUMBERS}
    values["back_emf_constant"] = error["torque_constant"] * motor.back_emf_constant
    # A motor without a gear has no losses of a gear, and no gear has an efficiency above one.
    efficiency = min(values["gear_efficiency"], 1.0)
    values["gear_efficiency"] = 1.0 if motor.gear_ratio == 1.0 else efficiency
    wrong = dataclasses.replace(env.actuator, motor=dataclasses.replace(motor, **values))
    delay = Disturbances(command_delay=error["delay"] * find_task(task).step_duration)
    return study_env(task, wrong, disturbances=delay)


@functools.cache
def arm(task: str, kind: str) -> Arm:
    """Return the training on ideal forces, or through the true motor."""
    return make_arm(task, kind, make_env(task, IDEAL if kind == IDEAL_KIND else MOTOR))


def judging_trial(task: str, kind: str, test: str = MOTOR) -> Trial:
    """Return the test that judges policies on ideal forces or on the true motor."""
    return Trial(arm(task, kind), test, make_env(task, test))


def choosing_trial(task: str, kind: str, criterion: str, group: int) -> Trial:
    """Return the test by which a group's policy is chosen."""
    name, env, seeds = f"{criterion}, choosing", make_env(task, criterion, group), None
    if criterion == WRONG_MOTOR:
        name, seeds = f"{criterion} {group}", BY_WRONG_MOTOR.candidates(group + 1)[group]
    return Trial(arm(task, kind), name, env, seeds, CHOOSING_EPISODES, CHOOSING_SEED)


def rule_trial(task: str, rule: Rule) -> Trial:
    """Return the test of a rule's policies on the true motor, for `ChosenScores`."""
    return Trial(arm(task, rule.kind), rule.name, make_env(task, MOTOR))


def all_trials(groups: int) -> tuple[Trial, ...]:
    """Return all tests of all policies, for a number of groups of ideal-trained policies."""
    tests = [judging_trial(task, IDEAL_KIND, IDEAL) for task in MOTORS]
    for task, rule in itertools.product(MOTORS, RULES):
        tests.append(judging_trial(task, rule.kind))
        tests += [
            choosing_trial(task, rule.kind, rule.criterion, group)
            for group in range(groups)
            if rule.criterion is not None
        ]
    return tuple({test.name: test for test in tests}.values())


class ChosenScores(questions.Scores):
    """Scores of policies by seed and, for the trial of a rule, of its policies by group."""

    def __init__(self, collected: StudyResults, groups: int) -> None:
        """Compute the span of each task."""
        ideal_trials = [judging_trial(task, IDEAL_KIND, IDEAL) for task in MOTORS]
        super().__init__(collected, FLOORS, ideal_trials)
        self._groups, pairs = groups, itertools.product(MOTORS, RULES)
        self._rules = {rule_trial(task, rule).name: rule for task, rule in pairs}

    def choices(self, task: str, rule: Rule) -> dict[int, int]:
        """Return the seed that a rule takes of each group whose tests are complete."""
        judged, choices = self.by_seed(judging_trial(task, rule.kind)), {}
        for group, candidates in enumerate(rule.candidates(self._groups)):
            values: Mapping[int, float] = dict.fromkeys(candidates, 0.0)
            if rule.criterion is not None:
                values = self.by_seed(choosing_trial(task, rule.kind, rule.criterion, group))
            if all(seed in values and seed in judged for seed in candidates):
                # `max` takes the lowest seed of those with the same score.
                choices[group] = max(candidates, key=values.__getitem__)
        return choices

    def by_seed(self, trial: Trial) -> dict[int, float]:
        """Return the score of every policy by seed; of a rule's policies by group."""
        rule, task = self._rules.get(trial.name), trial.arm.task
        if rule is None:
            return super().by_seed(trial)
        judged = super().by_seed(judging_trial(task, rule.kind))
        return {group: judged[seed] for group, seed in self.choices(task, rule).items()}


def comparisons() -> list[questions.TrialComparison]:
    """Return a comparison for each statement and motor."""
    return [
        questions.TrialComparison(
            f"{name}, {pages.TITLES[task]}",
            name,
            treatment.name,
            questions.Contrast(rule_trial(task, treatment), rule_trial(task, control)),
        )
        for (name, treatment, control, _), task in itertools.product(STATEMENTS, MOTORS)
    ]


def score_table(collected: StudyResults, scores: ChosenScores) -> str:
    """Return the table of the policies that each rule takes, on the true motor."""
    rows = []
    for task, rule in itertools.product(MOTORS, RULES):
        success = collected.scores(judging_trial(task, rule.kind), "success")
        percents = [100.0 * success[seed] for seed in scores.choices(task, rule).values()]
        values = list(scores.by_seed(rule_trial(task, rule)).values())
        failed = f"{sum(value < 1.0 - FAILURE_MARGIN for value in values)} of {len(values)}"
        means = [f"{np.mean(values):.3f}", f"{np.mean(percents):.0f}"] if values else ["–", "–"]
        rows.append([pages.TITLES[task], rule.name, failed, *means])
    return pages.markdown_table(("task", "policies", "failed", "score", "success [%]"), rows, 3)


def conclusions(judged: Sequence[questions.ComparisonVerdict]) -> str:
    """Return the table of the statements with their verdicts."""
    rows = []
    for statement in STATEMENTS:
        outcomes = [item.outcome for item in judged if item.comparison.section == statement.name]
        counts = ", ".join(f"{n} {name}" for name, n in collections.Counter(outcomes).items())
        verdict = f"**{statement.conclude(outcomes)}** ({counts})"
        rows.append([statement.name, statement.text, verdict])
    return pages.markdown_table(("", "statement", "verdict"), rows)


def choice_rows(scores: ChosenScores) -> Iterator[dict[str, object]]:
    """Yield a row for the policy that each rule takes of each group."""
    for task, rule in itertools.product(MOTORS, RULES):
        values = scores.by_seed(rule_trial(task, rule))
        for group, seed in scores.choices(task, rule).items():
            identity = {"task": task, "rule": rule.name, "group": group, "seed": seed}
            yield {**identity, "score": values[group]}


@dataclasses.dataclass(frozen=True, kw_only=True)
class ChooseStudy(Program):
    """Run or resume the comparison of choosing with training, and write its rows and page.

    Finished results are not computed again: docs/studies.md. Example: python
    scripts/study_choose.py --dry-run
    """

    PUBLISH_EACH_TRAINING: ClassVar[bool] = True

    root: Path = Path("runs/choose")
    """Folder of the run folders."""
    seeds: int = integer(100, minimum=2 * GROUP)
    """Ideal-trained policies of each task; half as many are trained through its motor."""
    episodes: int = integer(200, minimum=1)
    """Test episodes that judge a policy."""

    def __post_init__(self) -> None:
        """Validate."""
        super().__post_init__()
        if self.seeds % (2 * GROUP):
            raise ValueError(f"seeds = {self.seeds}: must be a multiple of {2 * GROUP}, two groups")

    @property
    def grid(self) -> Grid:
        """Trainings and tests of the study."""
        groups = self.seeds // GROUP

        def seeds_of(trained: Arm) -> range:
            return training_seeds(trained.name.partition(": ")[2], groups)

        return Grid(self.root, all_trials(groups), seeds_of, self.episodes, self.out / FOLDER)

    def write(self) -> tuple[Iterable[Path], Mapping[str, str]]:
        """Write rows, verdicts and page of all existing results; return files and failures."""
        collected, groups = self.grid.collect(), self.seeds // GROUP
        scores, totals = ChosenScores(collected, groups), collected.totals
        complete = groups >= MIN_GROUPS and collected.complete
        judged = questions.judge_comparisons(scores, comparisons(), complete)
        verdicts = [verdict for item in judged for verdict in item[1:]]
        tables: Mapping[str, list[dict[str, object]]] = {
            RUNS: list(run_rows(collected, scores.by_seed)),
            CHOICES: list(choice_rows(scores)),
            HYPOTHESES: [verdict.row(len(verdicts)) for verdict in verdicts],
            WRONG_MOTORS: [{"group": group, **model_error(group)} for group in range(groups)],
        }
        folder, page = self.out / FOLDER, self.out / PAGE
        for name, rows in tables.items():
            pages.write_csv(folder / name, rows)
        write_json(folder / TOTALS, totals._asdict())
        parts = [
            "# Choose a policy, or train through the motor?\n",
            conclusions(judged),
            questions.comparison_table(judged),
            score_table(collected, scores),
            f"The study follows [its plan](choose_plan.md), which defines all terms, with {groups}"
            f" groups of ideal-trained policies for each motor. It has {totals.trainings} trainings"
            f" ({totals.seconds / 3600:.1f} hours of one core); {totals.missing} trainings and"
            " tests are missing.\n",
        ]
        pages.write_page(page, parts)
        return [page, *(folder / name for name in (*tables, TOTALS))], collected.failures


if __name__ == "__main__":
    sys.exit(main(ChooseStudy))
