"""Arms and claims: the settings are the paper's, and a claim is confirmed exactly if it is true."""

import dataclasses
import types
from pathlib import Path

import numpy as np
import pytest

from codrl_mj.actuators import IDEAL, CurrentLoop, Motor
from codrl_mj.study.trials import format_ranges
from codrl_mj.tasks import find_task, named_actuator
from codrl_mj.training import TrainConfig
from reproduction.arms import ARMS, TASKS
from reproduction.checks import COMPATIBLE, CONFIRMED, NOT_CONFIRMED, NOT_TESTABLE, OPEN, OUTCOMES
from reproduction.claims import CLAIMS, PAPER_SAYS, PORT
from reproduction.drawn import band, running_mean
from reproduction.rows import (
    TESTED,
    UPRIGHT_ANGLE,
    UPRIGHT_SPEED,
    Trained,
    by_epoch,
    complete,
    epochs_of,
    joined,
    run_row,
    step_tracking,
    times_of,
    upright_since,
)
from reproduction.rows import first_epoch as reached
from tests.study.reproduction.worlds import OTHERS, PAPERS, made_up, trained, world

ARM = {arm.name: arm for arm in ARMS}


@pytest.mark.parametrize("arm", ARMS, ids=ARM)
def test_an_arm_has_the_paper_s_settings(arm):
    config = arm.training(7)
    preset = TrainConfig.preset(arm.task, config.agent.name, arm.settings, seed=7)
    assert (config.agent, config.seed, config.num_envs) == (preset.agent, 7, preset.num_envs)
    assert (config.total_steps, config.total_episodes) == (
        preset.total_steps,
        preset.total_episodes,
    )
    assert config.env == dataclasses.replace(preset.env, physics=arm.physics, actuator=arm.actuator)
    assert config.actuator == arm.actuator
    expected = {
        "paper gains": named_actuator("paper", arm.task),
        "fast gains": dataclasses.replace(
            named_actuator("paper", "mountain_car"),
            controller=CurrentLoop(kp=2.0, ki=10.0, kd=1e-6),
        ),
        "ideal": IDEAL,
    }
    assert arm.actuator == expected[arm.motor]


def test_the_gains_are_the_paper_s():
    """Source: the caption of each experiment in the paper; R = 1, L = 0.1, kT = 1 for all."""
    printed = {
        ("pendulum", "paper gains"): (1, 20, 1e-6, 0, 1.0),
        ("mountain_car", "paper gains"): (1, 1, 1e-2, 0, 1.0),
        ("mountain_car", "fast gains"): (2, 10, 1e-6, 0, 1.0),
        ("mountain_car_continuous", "paper gains"): (0.1, 10, 1e-3, 0, 1.0),
        ("acrobot", "paper gains"): (1, 10, 1e-6, 0, 1.0),
        ("cartpole", "paper gains"): (4.3, 1, 1e-6, 0.6, 0.15),
    }
    for arm in ARMS:
        if arm.actuator != IDEAL:
            kp, ki, kd, kff, radius = printed[arm.task, arm.motor]
            loop = arm.actuator.controller
            assert (loop.kp, loop.ki, loop.kd, loop.kff) == (kp, ki, kd, kff)
            assert arm.actuator.motor == Motor(
                resistance=1.0, inductance=0.1, torque_constant=1.0, arm_radius=radius
            )


def test_budgets_are_the_paper_s():
    budgets = {arm.task: (arm.config.total_episodes, arm.config.total_steps) for arm in ARMS}
    assert budgets == {
        "pendulum": (500, None),
        "mountain_car": (600, None),
        "mountain_car_continuous": (200, None),
        "acrobot": (500, None),
        "cartpole": (None, 60 * 4000),
    }


def test_every_experiment_has_ideal_and_actuated_arms():
    assert len(ARM) == len(ARMS)
    assert len(TASKS) == 5
    for task in TASKS:
        assert {arm.motor for arm in ARMS if arm.task == task} >= {"ideal", "paper gains"}
    assert {arm.task for arm in ARMS if arm.settings == "repaired"} == {
        "pendulum",
        "mountain_car_continuous",
    }
    assert {arm.task for arm in ARMS if arm.physics == "analytic"} == {"mountain_car", "cartpole"}


def test_a_trial_run_only_shortens_trainings():
    for arm in ARMS:
        assert arm.cut_off(3) == dataclasses.replace(
            arm, config=dataclasses.replace(arm.config, total_episodes=3)
        )


def test_every_claim_refers_to_existing_arms():
    for claim in CLAIMS:
        assert {ARM[name].task for name in claim.arms} == {claim.task}
    of = [
        (claim.task, claim.settings, claim.source, claim.statement, claim.measure.text)
        for claim in CLAIMS
    ]
    assert len(set(of)) == len(CLAIMS)


def test_the_paper_makes_22_statements_each_counted_once():
    counted = [
        (claim.task, claim.statement)
        for claim in CLAIMS
        if claim.source == PAPER_SAYS and claim.counted
    ]
    assert len(counted) == len(set(counted)) == 22
    beside = [claim for claim in CLAIMS if not claim.counted]
    assert (
        sum(claim.settings == "paper" and claim.task != "mountain_car" for claim in beside) == 5
    )  # as printed
    assert len(beside) == 5 + 2  # and the second look at who beats whom


def test_without_runs_no_claim_can_be_tested():
    nothing = {arm.name: [] for arm in ARMS}
    assert {claim.judge(nothing).outcome for claim in CLAIMS} == {NOT_TESTABLE}


def outcomes(rows, source):
    """Return outcome -> statements."""
    statements = {outcome: set() for outcome in OUTCOMES}
    for claim in CLAIMS:
        if claim.source == source and claim.counted:
            statements[claim.judge(rows).outcome].add((claim.task, claim.statement))
    return statements


def test_true_claims_are_confirmed_or_for_single_runs_compatible():
    statements = outcomes(world(PAPERS), PAPER_SAYS)
    assert statements[NOT_CONFIRMED] == statements[NOT_TESTABLE] == statements[OPEN] == set()
    assert statements[COMPATIBLE] == {
        ("mountain_car", "time to the goal"),
        ("mountain_car", "time to the goal, gains 2, 10, 1e-6"),
        ("mountain_car", "time to the goal, no motor"),
        ("mountain_car_continuous", "time to the goal"),
        ("cartpole", "first whole epoch"),
        ("cartpole", "first epoch with a return near 4000"),
    }
    assert outcomes(world(PAPERS), PORT)[CONFIRMED]


def test_false_claims_are_not_confirmed():
    refuted = outcomes(world(OTHERS), PAPER_SAYS)[NOT_CONFIRMED]
    assert refuted == {
        ("mountain_car", "return of the last 50 episodes"),
        ("mountain_car", "torque error, gains 2, 10, 1e-6"),
        ("mountain_car", "time to the goal"),
        ("mountain_car", "time to the goal, no motor"),
        ("mountain_car", "beats no motor"),
        ("mountain_car", "beats gains 2, 10, 1e-6"),
        ("acrobot", "torque error"),
        ("acrobot", "return of the last 50 episodes"),
        ("acrobot", "time to the goal"),
        ("cartpole", "largest torque error"),
        ("cartpole", "first whole epoch"),
        ("cartpole", "first epoch with a return near 4000"),
    }


def test_both_kinds_of_physics_are_compared_seed_by_seed():
    rows = world(OTHERS)
    (claim,) = [
        claim
        for claim in CLAIMS
        if claim.source == PORT and claim.task == "cartpole" and "ideal" in claim.arms[0]
    ]
    assert claim.judge(rows).reason == "no two values differ"
    mujoco_rows, other_rows = (rows[name] for name in claim.arms)
    shifted = [row | {"last_50": str(float(row["last_50"]) - 300)} for row in other_rows]
    assert claim.judge(rows | {claim.arms[1]: shifted}).outcome == NOT_CONFIRMED
    assert claim.judge(rows | {claim.arms[1]: shifted[4:]}).outcome == NOT_TESTABLE
    again = [
        *mujoco_rows,
        mujoco_rows[0] | {"run": "another", "last_50": "7"},
    ]  # of a seed trained twice the first is the pair's
    assert claim.judge(rows | {claim.arms[0]: again}).reason == "no two values differ"


# -- rows ------------------------------------------------------------------------------------------


def test_the_last_episodes_are_counted_from_the_end():
    arm = ARM["acrobot, paper, ideal, mujoco"]
    episodes = np.array([[n, 100 * n, -1000.0 if n < 10 else -10.0, 100] for n in range(60)])
    tests = {"test": dict.fromkeys(TESTED, 0.0) | {"episode_times_to_goal": [1.5, None]}}
    row = run_row(arm, 1, Trained(Path("nowhere"), episodes, tests, 60.0))
    assert (row["last_50"], row["times"]) == ("-10.0", "1.5 -")
    assert times_of(row["times"]).tolist() == [1.5, np.inf]


def test_statements_of_the_same_kind_have_the_same_check():
    """An inner loop reports its last torque; "about" is 5 on both sides, "under" excludes ties."""
    paper = [claim for claim in CLAIMS if claim.source == PAPER_SAYS]
    for claim in paper:
        if claim.statement.startswith("torque error"):
            has_inner_loop = find_task(claim.task).motor_inner_steps > 1
            assert claim.measure.column == (
                "tracking_step_percent" if has_inner_loop else "tracking_percent"
            )
        assert claim.says.startswith("about") == (claim.check.high - claim.check.low == 10.0)
        assert claim.says.startswith("under") == (claim.check.rule == "under")
    assert {
        claim.check.rule for claim in paper if claim.measure.text.startswith("share of test")
    } == {"behavior"}


def test_the_torque_error_of_the_last_inner_step_leaves_out_the_others():
    """Errors of 0 and 4 with desired torques of 3 and 4: rms 4 / rms 5."""
    episodes = [
        types.SimpleNamespace(
            signals={"desired_force": np.array([desired]), "actual_force": np.array([actual])},
            trace={"actual_force": np.full(10, 99.0)},
        )
        for desired, actual in ((3.0, 3.0), (-4.0, 0.0))
    ]
    assert step_tracking(episodes) == pytest.approx(80.0)
    assert (
        step_tracking(
            [
                types.SimpleNamespace(
                    signals=dict.fromkeys(("desired_force", "actual_force"), np.zeros(3))
                )
            ]
        )
        is None
    )


def test_a_row_is_replaced_by_its_training_but_not_by_one_with_other_packages():
    arm = ARM["acrobot, paper, ideal, mujoco"]
    row = made_up(arm)
    same_row, other_row = row | {"run": "renamed"}, row | {"run": "renamed", "returns": "7"}
    assert joined([row], same_row) == [same_row]
    assert joined([row], other_row) == [row, other_row]
    named = other_row | {"run": row["run"]}
    expected = [row, named | {"run": f"{row['run']} again"}]
    assert joined([row], named) == expected
    assert joined(expected, named) == expected
    assert complete([row], {"times", "returns"})
    assert not complete([row | {"times": ""}], {"times", "returns"})


@pytest.mark.parametrize(
    ("angle", "speed", "since"), [(0.19, 0.29, 0.0), (0.21, 0.0, None), (0.0, 0.31, None)]
)
def test_upright_is_defined_by_full_torque(angle, speed, since):
    """Full torque holds the rod at asin(2/5) = 2*0.2 rad and adds 0.3 rad/s in a step."""
    assert pytest.approx(np.arcsin(2 / 5) / 2, abs=0.01) == UPRIGHT_ANGLE
    assert pytest.approx(0.3) == UPRIGHT_SPEED
    time = 0.05 * np.arange(1, 201)
    state = np.tile([angle, speed], (201, 1))
    assert upright_since(types.SimpleNamespace(time=time, state=state)) == since
    late = np.where(np.arange(201)[:, None] < 180, [[3.0, 0.0]], [[0.0, 0.0]])
    time_upright = upright_since(types.SimpleNamespace(time=time, state=late))
    assert time_upright == pytest.approx(9.0)
    late[-1] = 3.0
    assert upright_since(types.SimpleNamespace(time=time, state=late)) is None


def test_episodes_are_sorted_into_the_epochs_in_which_they_end():
    run = trained(1)
    episodes = np.array([[1, 10, 5.0, 10], [2, 4000, 7.0, 3990], [3, 8001, 9.0, 4001]])
    epochs = by_epoch(dataclasses.replace(run, episodes=episodes), 4000, 4)
    assert epochs.counts.tolist() == [2, 0, 1, 0]
    np.testing.assert_array_equal(epochs.returns, [6.0, np.nan, 9.0, np.nan])
    np.testing.assert_array_equal(epochs.lengths, [2000.0, np.nan, 4001.0, np.nan])


@pytest.mark.parametrize(("epoch", "first"), [(33, 33), (61, 61)])
def test_a_level_that_is_never_reached_counts_as_the_last_epoch_plus_one(epoch, first):
    epochs = epochs_of(ARM["cartpole, paper, ideal, mujoco"], trained(3, epoch=epoch - 1))  # of 60
    assert reached(epochs.lengths >= 4000) == first


def test_the_running_mean_uses_the_available_values():
    values = np.arange(1.0, 8.0)
    expected = [values[max(0, end - 3) : end].mean() for end in range(1, 8)]
    assert running_mean(np.array([values, 2 * values]), 3) == pytest.approx(
        np.array([expected, 2 * np.array(expected)])
    )


def test_the_band_is_a_bootstrap_interval():
    """A quarter of the resamples of two values a and b has the mean a, and a quarter b."""
    mean, low, high = band(np.array([[0.0, 1.0], [4.0, 1.0]]))
    assert (mean.tolist(), low.tolist(), high.tolist()) == ([2.0, 1.0], [0.0, 1.0], [4.0, 1.0])
    single_seed = band(np.array([[3.0, 4.0]]))
    assert [bound.tolist() for bound in single_seed] == [[3.0, 4.0]] * 3


def test_seeds_as_text():
    assert format_ranges([7, 1, 0, 2, 5, 6, 9]) == "0 to 2, 5 to 7, 9"
    assert format_ranges([]) == ""
