"""Arms and claims: the settings are the paper's, and a claim is confirmed where it is so, and not where it is not."""

import dataclasses

import numpy as np
import pytest

from codrl_mj.actuators import IDEAL, CurrentLoop, Motor
from codrl_mj.study.trials import numbers_as_text
from codrl_mj.tasks import named_actuator
from codrl_mj.training import TrainConfig
from reproduction.arms import ARMS, TASKS
from reproduction.checks import COMPATIBLE, CONFIRMED, NOT_CONFIRMED, NOT_TESTABLE, OUTCOMES
from reproduction.claims import CLAIMS, LONG_EPOCH, PAPER_SAYS, PORT
from reproduction.figures import band, running_mean
from reproduction.series import Series, by_epoch
from tests.study.reproduction.worlds import OTHERS, PAPERS, trained, world

ARM = {arm.name: arm for arm in ARMS}


@pytest.mark.parametrize("arm", ARMS, ids=ARM)
def test_an_arm_is_trained_as_the_papers_settings_say(arm):
    config = arm.training(7)
    preset = TrainConfig.preset(arm.task, config.agent.name, arm.settings, seed=7)
    assert (config.agent, config.seed, config.num_envs) == (preset.agent, 7, preset.num_envs)
    assert (config.total_steps, config.total_episodes) == (preset.total_steps, preset.total_episodes)
    assert config.env == dataclasses.replace(preset.env, physics=arm.physics, actuator=arm.actuator)
    assert config.actuator == arm.actuator
    expected = {
        "paper gains": named_actuator("paper", arm.task),
        "fast gains": dataclasses.replace(
            named_actuator("paper", "mountain_car"), controller=CurrentLoop(kp=2.0, ki=10.0, kd=1e-6)
        ),
        "ideal": IDEAL,
    }
    assert arm.actuator == expected[arm.motor]


def test_the_gains_are_those_that_the_paper_prints():
    """Each experiment's caption in the paper; R = 1, L = 0.1, kT = 1 for all."""
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
            assert arm.actuator.motor == Motor(resistance=1.0, inductance=0.1, torque_constant=1.0, arm_radius=radius)


def test_budgets_are_the_papers():
    budgets = {arm.task: (arm.config.total_episodes, arm.config.total_steps) for arm in ARMS}
    assert budgets == {
        "pendulum": (500, None),
        "mountain_car": (600, None),
        "mountain_car_continuous": (200, None),
        "acrobot": (500, None),
        "cartpole": (None, 60 * 4000),
    }


def test_every_experiment_is_there_ideal_and_actuated():
    assert len(ARM) == len(ARMS)
    assert len(TASKS) == 5
    for task in TASKS:
        assert {arm.motor for arm in ARMS if arm.task == task} >= {"ideal", "paper gains"}
    assert {arm.task for arm in ARMS if arm.settings == "repaired"} == {"pendulum", "mountain_car_continuous"}
    assert {arm.task for arm in ARMS if arm.physics == "analytic"} == {"mountain_car", "cartpole"}


def test_trying_out_cuts_trainings_off_and_changes_nothing_else():
    for arm in ARMS:
        assert arm.cut_off(3) == dataclasses.replace(arm, config=dataclasses.replace(arm.config, total_episodes=3))


def test_every_claim_is_about_arms_that_there_are():
    for claim in CLAIMS:
        assert {ARM[name].task for name in claim.arms} == {claim.task}
    identities = [(claim.task, claim.physics, claim.source, claim.statement, claim.measure.text) for claim in CLAIMS]
    assert len(set(identities)) == len(CLAIMS)


def test_without_runs_no_claim_can_be_tested():
    nothing = {arm.name: Series(arm, {}) for arm in ARMS}
    assert {claim.judge(nothing).outcome for claim in CLAIMS} == {NOT_TESTABLE}


def outcomes(series, source):
    """Outcome -> statements."""
    found = {outcome: set() for outcome in OUTCOMES}
    for claim in CLAIMS:
        if claim.source == source:
            found[claim.judge(series).outcome].add((claim.task, claim.statement))
    return found


def test_where_the_paper_is_right_what_it_read_off_one_run_is_compatible_and_all_else_is_confirmed():
    found = outcomes(world(PAPERS), PAPER_SAYS)
    assert found[NOT_CONFIRMED] == found[NOT_TESTABLE] == set()
    assert found[COMPATIBLE] == {
        ("mountain_car", "gains 1, 1, 1e-2: about -114"),
        ("mountain_car", "gains 1, 1, 1e-2: goal in 85 s"),
        ("mountain_car", "gains 2, 10, 1e-6: goal in 100 s"),
        ("mountain_car", "ideal: goal in 160 s"),
        ("mountain_car_continuous", "as printed: goal in 75 s"),
        ("mountain_car_continuous", "repaired: goal in 75 s"),
        ("acrobot", "the return converges to about -200"),
        ("acrobot", "goal in about 25 s"),
        ("cartpole", "episodes last the whole epoch from 32 on"),
        ("cartpole", "the return approaches 4000 after epoch 35"),
    }
    assert outcomes(world(PAPERS), PORT)[CONFIRMED]


def test_where_the_paper_is_not_right_its_claims_are_not_confirmed():
    refuted = outcomes(world(OTHERS), PAPER_SAYS)[NOT_CONFIRMED]
    beats = "imperfect tracking (gains 1, 1, 1e-2) beats"
    assert refuted == {
        ("pendulum", "as printed: upright and still within 10 s"),
        ("mountain_car", "gains 1, 1, 1e-2: about -114"),
        ("mountain_car", "gains 2, 10, 1e-6: tracking is perfect"),
        ("mountain_car", "gains 1, 1, 1e-2: goal in 85 s"),
        ("mountain_car", "ideal: goal in 160 s"),
        ("mountain_car", f"{beats} the ideal environment"),
        ("mountain_car", f"{beats} perfect tracking (gains 2, 10, 1e-6)"),
        ("mountain_car_continuous", "as printed: the return is about 95"),
        ("mountain_car_continuous", "as printed: goal in 75 s"),
        ("acrobot", "the desired torque is well tracked"),
        ("acrobot", "the return converges to about -200"),
        ("acrobot", "goal in about 25 s"),
        ("cartpole", "the torque error is within ±0.1 N·m"),
        ("cartpole", "episodes last the whole epoch from 32 on"),
        ("cartpole", "the return approaches 4000 after epoch 35"),
    }


def test_both_kinds_of_physics_are_compared_seed_by_seed():
    series = world(OTHERS)
    (claim,) = [
        claim for claim in CLAIMS if claim.source == PORT and claim.task == "cartpole" and "ideal" in claim.arms[0]
    ]
    assert claim.judge(series).reason == "no two values differ"
    mine, other = (series[name] for name in claim.arms)
    shifted = {
        seed: dataclasses.replace(run, episodes=run.episodes - [[0, 0, 300, 0]]) for seed, run in other.runs.items()
    }
    moved = {mine.arm.name: mine, other.arm.name: Series(other.arm, shifted)}
    assert claim.judge(moved).outcome == NOT_CONFIRMED
    one_shared = {mine.arm.name: mine, other.arm.name: Series(other.arm, {4: shifted[4]})}
    assert claim.judge(one_shared).outcome == NOT_TESTABLE


# -- series -------------------------------------------------------------------------------------------------


def test_the_last_episodes_are_counted_from_the_end():
    run = trained(1, last=-10.0)
    run.episodes[:10, 2] = -1000.0  # of 60
    series = Series(ARMS[0], {1: run})
    assert series.last_returns() == [-10.0]
    assert series.last_returns(60) == [(-10 * 50 - 1000 * 10) / 60]


def test_episodes_are_sorted_into_the_epochs_in_which_they_end():
    run = trained(1)
    episodes = np.array([[1, 10, 5.0, 10], [2, 4000, 7.0, 3990], [3, 8001, 9.0, 4001]])
    epochs = by_epoch(dataclasses.replace(run, episodes=episodes), 4000, 4)
    assert epochs.counts.tolist() == [2, 0, 1, 0]
    np.testing.assert_array_equal(epochs.returns, [6.0, np.nan, 9.0, np.nan])
    np.testing.assert_array_equal(epochs.lengths, [2000.0, np.nan, 4001.0, np.nan])


@pytest.mark.parametrize(("epoch", "first"), [(33, 33), (61, 61)])
def test_a_level_that_is_never_reached_counts_as_one_epoch_more_than_there_are(epoch, first):
    (arm,) = [arm for arm in ARMS if arm.name == "cartpole, paper, ideal, mujoco"]  # 60 epochs
    assert LONG_EPOCH.values(Series(arm, {0: trained(3, epoch=epoch - 1)})) == [first]


def test_failures_take_infinitely_long():
    series = Series(ARMS[0], {1: trained(1, success=0.0), 2: trained(2, success=1.0, time=10.0)})
    never, always = series.times_to_goal()
    assert np.isinf(never).all()
    assert np.median(always) == 11.0


def test_the_running_mean_is_over_what_there_is():
    values = np.arange(1.0, 8.0)
    expected = [values[max(0, end - 3) : end].mean() for end in range(1, 8)]
    assert running_mean(np.array([values, 2 * values]), 3) == pytest.approx(
        np.array([expected, 2 * np.array(expected)])
    )


def test_the_band_is_the_bootstraps():
    """Two values a and b: a quarter of the resamples has the mean a, a quarter b: the 95 % interval is from a to b."""
    mean, low, high = band(np.array([[0.0, 1.0], [4.0, 1.0]]))
    assert (mean.tolist(), low.tolist(), high.tolist()) == ([2.0, 1.0], [0.0, 1.0], [4.0, 1.0])
    alone = band(np.array([[3.0, 4.0]]))
    assert [bound.tolist() for bound in alone] == [[3.0, 4.0]] * 3


def test_seeds_as_text():
    assert numbers_as_text([7, 1, 0, 2, 5, 6, 9]) == "0 to 2, 5 to 7, 9"
    assert numbers_as_text([]) == ""
