"""The study of choosing: its choices, its verdicts on rows with known differences, and its plan."""

import dataclasses
import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest

import study_choose
from codrl_mj.agents import PPOConfig
from codrl_mj.study.axes import FLOORS
from codrl_mj.study.pages import TITLES, read_csv, write_csv
from codrl_mj.study.parallel import Workers
from codrl_mj.study.questions import MARGIN
from codrl_mj.study.trials import MEASURES, RUNS, Arm, Grid
from codrl_mj.training import EVALUATION_SEED, TrainConfig
from study_choose import (
    CHOICES,
    CHOOSING_EPISODES,
    CHOOSING_SEED,
    FIRST_SEED,
    FOLDER,
    GROUP,
    HYPOTHESES,
    MIN_GROUPS,
    MOTORS,
    PAGE,
    RULES,
    STATEMENTS,
    WRONG_MOTORS,
    ChooseStudy,
    Statement,
    make_env,
    model_error,
)
from tests.matrix import matrix_params

RESULTS = Path(__file__).parents[2] / "docs/results"
PLAN = RESULTS / "choose_plan.md"
# Scores by the place of an ideal-trained policy in its group: on the true motor, on the wrong one,
# on ideal forces in the choosing test. A policy trained through the motor has the last five.
RISING, BEST_IS_THIRD = (0.1, 0.2, 0.3, 0.4, 0.5), (0.1, 0.2, 0.9, 0.3, 0.4)
SCORES = {
    "furuta": ((0.5, 0.6, 1.0, 0.7, 0.4), BEST_IS_THIRD, RISING, (1.0,) * 5),
    "pendulum": ((0.5, 0.6, 1.0, 0.7, 0.3), RISING, BEST_IS_THIRD, (1.2,) * 5),
    "acrobot": ((0.9, 0.6, 1.0, 0.7, 0.91), BEST_IS_THIRD, RISING, (0.5, 0.5, 0.6, 1.3, 0.7)),
    "cartpole": ((1.0,) * 5, (0.5,) * 5, (0.5,) * 5, (-1.0, 2.9, 0.9, 1.0, 1.0)),
}
VERDICTS = {
    "furuta": ("equivalent", "equivalent", "worse", "better"),
    "pendulum": ("worse", "worse", "better", "worse"),
    "acrobot": ("better", "worse", "equivalent", "better"),
    "cartpole": ("undecided", "worse", "equivalent", "equivalent"),
}


def known_score(task, kind, test, seed):
    """Return the score of a policy in a test; groups differ by at most 0.01."""
    index, group = (seed - FIRST_SEED) % GROUP, (seed - FIRST_SEED) // GROUP
    if kind == "through":
        index, group = (seed - FIRST_SEED) // 2 % GROUP, (seed - FIRST_SEED) // (2 * GROUP)
    motor, wrong_motor, ideal_choosing, through = SCORES[task]
    levels = through if kind == "through" else motor
    if test.startswith("wrong motor"):
        levels = wrong_motor
    elif test == "ideal, choosing":
        levels = ideal_choosing
    elif test == "ideal":
        levels = (1.0,) * GROUP
    noise = 0.0 if test == "ideal" or task == "cartpole" else 0.01 * math.sin(3.0 * group)
    return levels[index] + noise


def write_rows(study, score=known_score, seeds=None):
    """Write a row for every policy and test, or for the policies with some seeds."""
    grid, rows = study.grid, []
    for trial, seed in grid.policy_tests:
        arm_name, _, test = trial.partition(" on ")
        task, _, kind = arm_name.partition(": ")
        rows.append(
            {
                "task": task,
                "trained": kind,
                "tested": test,
                "seed": seed,
                "returns": FLOORS[task] + 100.0 * score(task, kind, test, seed),
                **dict.fromkeys(MEASURES, 0.5),
                "run": grid.folders[arm_name, seed].name,
            }
        )
    written = [row for row in rows if seeds is None or row["seed"] in seeds]
    write_csv(study.out / FOLDER / RUNS, written)
    return rows


def make_study(out, seeds=100, **fields):
    (out / FOLDER).mkdir(exist_ok=True)
    return ChooseStudy(root=out / "runs", out=out, seeds=seeds, **fields)


@pytest.fixture
def study(tmp_path):
    return make_study(tmp_path)


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """Return the study with all rows and its page."""
    study = make_study(tmp_path_factory.mktemp("choose"))
    write_rows(study)
    study.write()
    return study


def verdicts_of(study):
    """Return the verdicts of the page's comparisons, and those of its statements, by name."""
    page = (study.out / PAGE).read_text()
    comparisons = re.findall(r"^\| (C\d), (.*?) \|.*\| ([a-z ]+) \|$", page, re.MULTILINE)
    statements = re.findall(r"^\| (C\d) \| .* \| \*\*([a-z ]+)\*\*", page, re.MULTILINE)
    return {tuple(key): verdict for *key, verdict in comparisons}, dict(statements)


def test_rows_with_known_differences_get_the_true_verdicts(judged):
    comparisons, statements = verdicts_of(judged)
    assert comparisons == {
        (statement.name, TITLES[task]): verdict
        for task, verdicts in VERDICTS.items()
        for statement, verdict in zip(STATEMENTS, verdicts, strict=True)
    }
    assert statements == {"C1": "refuted", "C2": "refuted", "C3": "refuted", "C4": "refuted"}
    page = (judged.out / PAGE).read_text()
    # The same noise of a group is in both of its policies, and cancels.
    assert "| C4, Pendulum | -0.200 [-0.200, -0.200] |" in page
    assert "| CartPole | random trained-through policy | 10 of 20 | 0.950 | 50 |" in page
    assert "| Furuta pendulum | random ideal-trained policy | 20 of 20 | 0.50" in page


@pytest.mark.parametrize(
    ("refuted_by", "outcomes", "verdict"),
    [
        ("worse", ["better", "equivalent"], "confirmed"),
        ("worse", ["better", "undecided"], "open"),
        ("worse", ["undecided", "worse"], "refuted"),
        ("better", ["worse", "equivalent"], "confirmed"),
        ("better", ["worse", "undecided"], "open"),
        ("better", ["undecided", "better"], "refuted"),
        ("worse", ["worse", "not judged"], "not judged"),
    ],
)
def test_a_statement_needs_every_motor(refuted_by, outcomes, verdict):
    statement = Statement("", *STATEMENTS[0][1:3], refuted_by)
    assert statement.conclude(outcomes) == verdict


def test_all_hypotheses_are_corrected_together(judged):
    rows = read_csv(judged.out / FOLDER / HYPOTHESES)
    assert len(rows) == 2 * len(STATEMENTS) * len(MOTORS) == 32
    p = np.array([float(row["p"]) for row in rows])
    corrected = np.array([float(row["corrected_p"]) for row in rows])
    np.testing.assert_allclose(corrected[np.argmin(p)], min(32 * p.min(), 1.0), rtol=1e-12)
    assert np.all(corrected >= p)
    assert {row["policies"] for row in rows if row["question"] != "C2"} == {"20"}
    assert {row["policies"] for row in rows if row["question"] == "C2"} == {"10"}


def test_a_choice_is_the_best_of_its_group_in_the_choosing_test(study):
    random = np.random.default_rng(0)
    # Three possible scores give ties in most groups.
    drawn = {
        key: float(random.choice([0.2, 0.5, 0.8]))
        for key in itertools.product(
            MOTORS,
            ("ideal", "through"),
            ("ideal", "motor", "ideal, choosing", "motor, choosing", "wrong"),
            range(FIRST_SEED, FIRST_SEED + 100),
        )
    }

    def score(task, kind, test, seed):
        name = "wrong" if test.startswith("wrong") else test
        return 1.0 if test == "ideal" else drawn[task, kind, name, seed]

    write_rows(study, score)
    study.write()
    rows = read_csv(study.out / FOLDER / CHOICES)
    choices = {
        (row["task"], row["rule"], int(row["group"])): (int(row["seed"]), float(row["score"]))
        for row in rows
    }
    criteria = {
        "ideal-trained policy chosen on ideal forces": "ideal, choosing",
        "ideal-trained policy chosen on the wrong motor": "wrong",
        "ideal-trained policy chosen on the true motor": "motor, choosing",
    }
    expected = {}
    for task in MOTORS:
        for group in range(20):
            seeds = [100 + 5 * group + index for index in range(5)]
            chosen_seeds = {"random ideal-trained policy": seeds[0]}
            for rule, test in criteria.items():
                best = max(drawn[task, "ideal", test, seed] for seed in seeds)
                ties = [seed for seed in seeds if drawn[task, "ideal", test, seed] == best]
                chosen_seeds[rule] = min(ties)
            for rule, seed in chosen_seeds.items():
                expected[task, rule, group] = seed, drawn[task, "ideal", "motor", seed]
            # The first and second policy trained through the motor of every five.
            seed = 100 + 10 * (group // 2) + 2 * (group % 2)
            expected[task, "random trained-through policy", group] = (
                seed,
                drawn[task, "through", "motor", seed],
            )
        for group in range(10):
            seeds = [100 + 10 * group + 2 * index for index in range(5)]
            tests = [drawn[task, "through", "motor, choosing", seed] for seed in seeds]
            seed = seeds[tests.index(max(tests))]
            expected[task, "trained-through policy chosen on the true motor", group] = (
                seed,
                drawn[task, "through", "motor", seed],
            )
    assert choices.keys() == expected.keys()
    for key, (seed, value) in expected.items():
        assert choices[key] == (seed, pytest.approx(value)), key


def test_nothing_is_judged_before_all_rows_exist(study):
    rows = write_rows(study)
    write_csv(study.out / FOLDER / RUNS, rows[:-1])
    study.write()
    comparisons, statements = verdicts_of(study)
    assert set(comparisons.values()) == set(statements.values()) == {"not judged"}
    assert {row["corrected_p"] for row in read_csv(study.out / FOLDER / HYPOTHESES)} == {""}
    assert len(read_csv(study.out / FOLDER / RUNS)) == len(rows) - 1


def test_an_early_end_is_judged_with_the_complete_groups(study):
    finished = range(FIRST_SEED, FIRST_SEED + 73)
    write_rows(study, seeds=finished)
    study.write()
    assert set(verdicts_of(study)[1].values()) == {"not judged"}
    early = make_study(study.out, seeds=70)
    early.write()
    assert verdicts_of(early)[0]["C4", "Furuta pendulum"] == "better"
    assert verdicts_of(early)[1]["C1"] == "refuted"
    assert "with 14 groups of ideal-trained policies" in (early.out / PAGE).read_text()
    rows = read_csv(early.out / FOLDER / HYPOTHESES)
    assert {row["policies"] for row in rows if row["question"] == "C2"} == {"7"}
    too_early = make_study(study.out, seeds=50)
    too_early.write()
    assert set(verdicts_of(too_early)[1].values()) == {"not judged"}


def test_the_fewest_groups_can_show_a_difference():
    """Flips of the signs of n differences have p-values of at least 2 in 2**n."""
    hypotheses = 2 * len(STATEMENTS) * len(MOTORS)
    assert hypotheses * 2 / 2**MIN_GROUPS < 0.05
    assert hypotheses * 2 / 2 ** (MIN_GROUPS - 2) > 0.05


def test_part_of_a_block_is_refused():
    with pytest.raises(ValueError, match="multiple of 10"):
        ChooseStudy(seeds=75)


def test_any_ten_seeds_have_two_ideal_groups_and_one_other(study):
    cells = list(study.grid.cells)
    assert len(cells) == 600
    for block in range(10):
        names = [name for name, _ in cells[60 * block : 60 * (block + 1)]]
        counts = {name: names.count(name) for name in names}
        assert counts == {
            f"{task}: {kind}": count
            for task in MOTORS
            for kind, count in (("ideal", 10), ("through", 5))
        }


def test_one_job_publishes_each_training(study, monkeypatch):
    parts = []
    monkeypatch.setattr(Grid, "compute", lambda grid, *_, **__: parts.append(tuple(grid.cells)))
    dataclasses.replace(study, workers=Workers(jobs=1)).run()
    *single, whole = parts
    assert single == [(cell,) for cell in whole]
    assert whole == tuple(study.grid.cells)


def test_choosing_and_judging_have_other_starts(study):
    tests = study.grid.policy_tests
    starts = {}
    for (trial, _), test in tests.items():
        is_choosing = "choosing" in trial or "wrong motor" in trial
        episodes = range(test.seed, test.seed + test.episodes)
        starts.setdefault(is_choosing, set()).add(episodes)
    assert starts == {
        True: {range(CHOOSING_SEED, CHOOSING_SEED + CHOOSING_EPISODES)},
        False: {range(EVALUATION_SEED, EVALUATION_SEED + 200)},
    }
    assert not set(*starts[True]) & set(*starts[False])
    # Each policy meets the wrong motor of its own group, and no other.
    for task in MOTORS:
        met = [key for key in tests if key[0].startswith(f"{task}: ideal on wrong motor")]
        assert met == [
            (f"{task}: ideal on wrong motor {group}", FIRST_SEED + GROUP * group + index)
            for group in range(20)
            for index in range(GROUP)
        ]


def test_the_wrong_motor_is_20_percent_wrong(judged):
    published = read_csv(judged.out / FOLDER / WRONG_MOTORS)
    for group, task in itertools.product(range(20), MOTORS):
        error = model_error(group)
        assert {name: float(published[group][name]) for name in error} == error
        delay = error.pop("delay")
        assert delay in (0.0, 0.2)
        assert set(error.values()) <= {0.8, 1.2}
        true, wrong = make_env(task, "motor"), make_env(task, "wrong motor", group)
        step = {"furuta": 0.02, "pendulum": 0.05, "acrobot": 0.2, "cartpole": 0.02}[task]
        assert wrong.disturbances.command_delay == pytest.approx(delay * step)
        assert wrong.actuator.controller == true.actuator.controller
        assert wrong.actuator.supply == true.actuator.supply
        error["back_emf_constant"] = error["torque_constant"]
        efficiency = true.actuator.motor.gear_efficiency * error.pop("gear_efficiency")
        expected = vars(true.actuator.motor) | {
            name: factor * getattr(true.actuator.motor, name) for name, factor in error.items()
        }
        # Furuta's motor has no gear.
        expected["gear_efficiency"] = 1.0 if task == "furuta" else min(efficiency, 1.0)
        assert vars(wrong.actuator.motor) == pytest.approx(expected)
        assert dataclasses.replace(wrong, actuator=true.actuator, disturbances=None) == (
            dataclasses.replace(true, disturbances=None)
        )


@pytest.mark.parametrize("task", matrix_params(["cartpole"], MOTORS))
def test_a_wrong_motor_can_be_simulated(task):
    env = make_env(task, "wrong motor", 3).build()
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


def test_the_study_is_that_of_the_plan():
    plan, grid = " ".join(PLAN.read_text().split()), ChooseStudy().grid
    assert f"There are {len(grid.cells)} trainings and {len(grid.policy_tests)} tests" in plan
    comparisons = len(STATEMENTS) * len(MOTORS)
    assert f"Each of the {comparisons} comparisons has two hypotheses" in plan
    assert f"All {2 * comparisons} p-values are corrected together" in plan
    assert f"less than {MARGIN} of the span" in plan
    assert f"With less than {MIN_GROUPS} groups" in plan
    assert f"| judging: the true motor | {grid.episodes} | {EVALUATION_SEED:,} |" in plan
    assert f"the group's wrong motor | {CHOOSING_EPISODES} | {CHOOSING_SEED:,} |" in plan
    for task, motor in MOTORS.items():
        ratio = motor["motor"]["gear_ratio"]
        assert f"| {TITLES[task]} | {motor['name']}, {ratio:g}:1" in plan
    errors = [model_error(group) for group in range(20)]
    high = {name: sum(error[name] > 1 for error in errors) for name in errors[0]}
    assert (
        f"{high['resistance']} have too high a resistance, {high['inductance']} inductance,"
        f" {high['torque_constant']} torque constant, {high['rotor_inertia']} inertia,"
        f" {high['coulomb_friction']} friction, {high['gear_efficiency']} efficiency;"
        f" {sum(error['delay'] > 0 for error in errors)} have the delay"
    ) in plan


def test_the_pages_quote_what_a_choice_on_ideal_forces_costs():
    """The best of five by the score on ideal forces, over all groups of the first study's rows."""
    rows = [
        row
        for row in read_csv(RESULTS / "actuators" / RUNS)
        if (row["task"], row["trained"]) == ("furuta", "ideal")
    ]
    ideal, weak = (
        {row["seed"]: float(row["score"]) for row in rows if row["tested"] == test}
        for test in ("ideal", "weakness 0.55")
    )
    chosen = [weak[max(five, key=ideal.get)] for five in itertools.combinations(ideal, GROUP)]
    assert len(chosen) == math.comb(20, GROUP)
    for page in (RESULTS / "actuators.md", RESULTS.parent / "my_policy_fails.md"):
        text = " ".join(page.read_text().split())
        assert "with 55 % of the force missing, the best of five" in text
        assert f"{np.mean(chosen):.2f}" == "0.14"
        assert re.search(r"by that score (keeps|kept) 0\.14 ", text)
        assert f"a random one {np.mean(list(weak.values())):.2f}" in text


def test_a_tiny_study_trains_chooses_and_resumes(tmp_path, monkeypatch, capsys):
    agent = PPOConfig(rollout_steps=64, batch_size=64, epochs=1, hidden=(8,))
    never = 10**9

    def tiny_arm(task, kind):
        env = make_env(task, "ideal" if kind == "ideal" else "motor")
        config = TrainConfig(
            env,
            agent,
            0,
            64,
            num_envs=1,
            evaluation_interval=never,
            evaluation_episodes=1,
            checkpoint_interval=never,
        )
        return Arm(f"{task}: {kind}", config, 1.0)

    monkeypatch.setattr(study_choose, "arm", tiny_arm)
    monkeypatch.setattr(study_choose, "MOTORS", {"cartpole": MOTORS["cartpole"]})
    monkeypatch.setattr(study_choose, "CHOOSING_EPISODES", 1)
    study = make_study(tmp_path, seeds=10, episodes=2, workers=Workers(jobs=1))
    assert study.run() == 0
    capsys.readouterr()
    rows = read_csv(tmp_path / FOLDER / RUNS)
    # Ten ideal-trained policies have five tests each, and five others have two.
    assert len(rows) == 10 * 5 + 5 * 2
    page = (tmp_path / PAGE).read_text()
    assert "It has 15 trainings" in page
    assert "; 0 trainings and tests are missing." in page
    choices = read_csv(tmp_path / FOLDER / CHOICES)
    scores = {(row["trained"], row["tested"], row["seed"]): float(row["score"]) for row in rows}
    groups = {rule.name: 1 if rule.name.startswith("trained") else 2 for rule in RULES}
    assert len(choices) == sum(groups.values())
    for choice in choices:
        kind = "through" if "trained-through" in choice["rule"] else "ideal"
        assert float(choice["score"]) == pytest.approx(scores[kind, "motor", choice["seed"]])
    # Without the run folders, the rows take their place.
    study.root.rename(tmp_path / "gone")
    assert study.run() == 0
    assert not list(study.root.glob("cartpole*"))
    assert read_csv(tmp_path / FOLDER / CHOICES) == choices
