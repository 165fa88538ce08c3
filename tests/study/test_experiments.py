"""The experiments: what they train and test, and that configurations differ in what is meant and in nothing else."""

import dataclasses
import itertools

import numpy as np
import pytest

from codrl_mj.envs.distributions import parse
from codrl_mj.study.conditions import check_condition, conditions, every_condition, ladder, stall_supply
from codrl_mj.study.experiments import EXPERIMENTS
from codrl_mj.study.plan import AGENTS, Arm
from codrl_mj.tasks import find_task

TASKS = tuple(AGENTS)
DISCRETE = ("cartpole", "acrobot")
MATRIX = ["ideal", "paper", "weak", "weaker", "open_loop", "slow_winding", "low_voltage", "delay", "randomised"]


def arms(task):
    """Every arm of every experiment on a task."""
    return [arm for one in EXPERIMENTS.values() if (plan := one.plan(task)) is not None for arm in plan.arms]


def main_arm(task, condition, **changes):
    return Arm(task, AGENTS[task][0], every_condition(task)[condition], **changes)


def differing(one, other):
    """Names of the fields in which the trainings of two arms differ."""
    return {line.partition(":")[0] for line in one.config(0).differences(other.config(0))}


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    ("experiment", "trained", "tests"),
    [
        ("matrix", {"": 9}, {"": 81}),
        ("ladder", {"": 6, "pendulum": 7}, {"": 6 + 6 + 4, "pendulum": 7 + 7 + 5}),
        ("action", {"": 9}, {"": 9 + 3}),
        ("observation", {"": 8}, {"": 8 + 6}),
        ("randomised", {"": 9}, {"": 9 + 9 + 7}),
        ("reward", {"cartpole": 8}, {"cartpole": 32}),
        ("agents", {"": 6}, {"": 18}),
    ],
)
def test_the_experiments_are_as_large_as_documented(task, experiment, trained, tests):
    plan = EXPERIMENTS[experiment].plan(task)
    expected = trained.get(task, trained.get(""))
    if expected is None:
        assert plan is None
        return
    assert len(plan.arms) == expected
    assert len(plan.trials) == len({trial.name for trial in plan.trials}) == tests.get(task, tests.get(""))


@pytest.mark.parametrize(("task", "expected"), [("cartpole", 30), ("pendulum", 27), ("acrobot", 26)])
def test_a_name_is_one_training_and_a_training_one_name(task, expected):
    by_name = {}
    for arm in arms(task):
        assert by_name.setdefault(arm.name, arm.config(0)) == arm.config(0)
    assert len(by_name) == len({repr(config) for config in by_name.values()}) == expected


@pytest.mark.parametrize("task", TASKS)
def test_what_is_compared_is_tested_on_the_same_and_drawn_is_tried(task):
    for experiment in EXPERIMENTS.values():
        plan = experiment.plan(task)
        if plan is None:
            continue
        names = {trial.name for trial in plan.trials}
        assert plan.comparisons
        for pair in plan.comparisons:
            assert pair.one.test == pair.other.test
            assert pair.one.arm != pair.other.arm
            assert {pair.one.name, pair.other.name} <= names
        assert not plan.series or {trial.name for _, drawn in plan.series for trial in drawn} == names


@pytest.mark.parametrize("task", TASKS)
def test_conditions_differ_from_the_papers_actuator_only_in_what_their_names_say(task):
    assert [*conditions(task)] == MATRIX
    paper = main_arm(task, "paper")
    step = find_task(task).step_duration
    expected = {
        "slow_winding": {"env.actuator.motor.inductance"},
        "low_voltage": {"env.actuator.controller.max_voltage"},
        "stall_supply": {"env.actuator.controller.max_voltage"},
        "delay": {"env.disturbances.command_delay"},
        "randomised": {"env.randomize"},
    }
    for name, fields in expected.items():
        assert differing(main_arm(task, name), paper) == fields, name
    for name in ("weak", "weaker"):
        assert all(field.startswith("env.actuator.controller.k") for field in differing(main_arm(task, name), paper))
    assert conditions(task)["delay"].env.disturbances.command_delay == step
    motor = conditions(task)["paper"].actuator.motor
    holding = stall_supply(task).actuator.controller.max_voltage / motor.resistance * motor.torque_constant
    assert holding / motor.arm_radius == pytest.approx(find_task(task).max_force, rel=1e-12)


@pytest.mark.parametrize("task", TASKS)
def test_each_rung_of_the_ladder_adds_one_thing(task):
    rungs = list(ladder(task))
    added = {
        "paper": "env.actuator.controller.",
        "low_voltage": "env.actuator.controller.max_voltage",
        "late": "env.disturbances.command_delay",
        "coarse": "env.disturbances.command_quantum",
        "sagging": "env.actuator.supply",
    }
    assert rungs == ["ideal", "winding", *(name for name in added if name != "coarse" or task not in DISCRETE)]
    for before, rung in itertools.pairwise(rungs[1:]):
        fields = differing(main_arm(task, rung), main_arm(task, before))
        assert fields
        assert all(field.startswith(added[rung]) for field in fields), rung
    winding = ladder(task)["winding"].actuator
    assert winding.motor == ladder(task)["paper"].actuator.motor
    loop = winding.controller
    assert (loop.kp, loop.ki, loop.kd, loop.kff) == (0.0, 0.0, 0.0, winding.motor.resistance)
    known = conditions(task)
    assert all(rung == known[name] for name, rung in ladder(task).items() if name in known)


@pytest.mark.parametrize("task", TASKS)
def test_the_ideal_actuator_is_integrated_as_the_others_are(task):
    for condition in every_condition(task).values():
        env = condition.env.make()
        assert env.unwrapped.model.opt.timestep == find_task(task).step_duration / find_task(task).motor_inner_steps


@pytest.mark.parametrize("task", TASKS)
def test_variants_of_a_training_differ_in_one_thing(task):
    force = main_arm(task, "paper")
    assert differing(main_arm(task, "paper", observe=True), force) == {"env.observe_actuator"}
    levels = {"env.levels"} if task in DISCRETE else set()
    assert differing(main_arm(task, "paper", action="voltage"), force) == {"env.action"} | levels
    reward = {"env.options.center_radius"} if task == "cartpole" else set()
    assert differing(main_arm(task, "paper", plain_reward=True), force) == reward
    assert force.config(3) == dataclasses.replace(force.config(0), seed=3)
    assert force.config(0, 512) == dataclasses.replace(force.config(0), total_steps=512)


@pytest.mark.parametrize("task", TASKS)
def test_every_training_has_an_environment(task):
    for arm in {arm.name: arm for arm in arms(task)}.values():
        config = arm.config(0)
        env = config.env.make()
        env.reset(seed=0)
        env.step(env.action_space.sample())


@pytest.mark.parametrize("task", DISCRETE)
def test_voltages_to_choose_from_reach_the_whole_supply_both_ways_and_nothing(task):
    for condition in ("paper", "stall_supply", "slow_winding"):
        levels = np.array(main_arm(task, condition, action="voltage").config(0).env.levels)
        assert levels.max() == every_condition(task)[condition].actuator.controller.max_voltage
        np.testing.assert_array_equal(levels, -levels[::-1])
        assert 0.0 in levels


@pytest.mark.parametrize("task", TASKS)
def test_what_is_drawn_reaches_every_loop_and_motor_of_the_matrix(task):
    known = conditions(task)
    drawn = dict(item.split("=") for item in known["randomised"].env.randomize)
    for name in ("paper", "weak", "weaker", "open_loop", "slow_winding", "low_voltage"):
        for field, text in drawn.items():
            part, _, attribute = field.partition(".")
            value = getattr(getattr(known[name].actuator, part), attribute)
            bounds = parse(text)
            no_feedback = value == 0.0 and attribute in ("kp", "ki")  # no logarithm reaches it
            assert no_feedback or bounds.low <= value <= bounds.high, (name, field)


def test_an_unknown_condition_is_refused_and_the_nearest_named():
    check_condition("coarse", TASKS)
    with pytest.raises(ValueError, match=r"unknown condition 'weakr': did you mean 'weak(er)?'"):
        check_condition("weakr", TASKS)
    with pytest.raises(ValueError, match="unknown condition 'coarse'"):
        check_condition("coarse", DISCRETE)
