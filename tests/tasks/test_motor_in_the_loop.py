"""With the paper's actuator: MuJoCo against the analytic physics, and against itself in copies."""

import copy
import pickle

import mujoco
import numpy as np
import pytest

from codrl_mj.own_code import asset_path
from codrl_mj.physics import motors
from codrl_mj.tasks import TASKS
from tests.tasks.faces import NEW, actions, every_rebuilt, ours


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("task", "tolerance", "steps"),
    [
        ("pendulum", 1e-8, 200),
        ("acrobot", 1e-6, 100),  # chaotic
        ("mountain_car", 1e-8, 200),
        ("mountain_car_continuous", 1e-8, 999),
    ],
)
def test_both_physics_give_the_same_episode(task, tolerance, steps, seed):
    pair = [ours(task, physics=physics) for physics in ("mujoco", "analytic")]
    for env in pair:
        env.reset(seed=seed)
    for action in actions(task, seed, steps):
        results = [env.step(action) for env in pair]
        np.testing.assert_allclose(*(env.unwrapped.state for env in pair), rtol=0, atol=tolerance)
        np.testing.assert_allclose(*([*result[4].values()] for result in results), rtol=0, atol=10 * tolerance)
        np.testing.assert_allclose(*(result[1] for result in results), rtol=0, atol=100 * tolerance)
        assert results[0][2:4] == results[1][2:4]
        if any(results[0][2:4]):
            break


@every_rebuilt
def test_the_motor_is_in_the_loop(task):
    """Inner loops as the paper has them, and a force that follows the desired one but is not it."""
    env = ours(task).unwrapped
    definition = TASKS[task]
    assert env.model.opt.timestep == pytest.approx(definition.step_duration / definition.motor_inner_steps, rel=1e-15)
    env.reset(seed=0)
    signals = [env.step(action)[4] for action in actions(task, 0, 20)]
    errors = np.array([one["actual_force"] - one["desired_force"] for one in signals])
    assert 1e-12 < np.abs(errors).max() < 3 * definition.max_force


@every_rebuilt
def test_the_stored_model_holds_the_papers_actuator(task):
    model = mujoco.MjModel.from_xml_path(str(asset_path(TASKS[task].asset)))
    definition = TASKS[task]
    (found,) = motors(model).values()
    assert found == TASKS[task].paper[0]
    assert model.opt.timestep == pytest.approx(definition.step_duration / definition.motor_inner_steps, rel=1e-15)
    limit = definition.max_force * TASKS[task].paper[0].motor.arm_radius
    np.testing.assert_array_equal(model.actuator_ctrlrange, [[-limit, limit]])
    assert model.nq == len(definition.qpos)
    assert model.nv == len(definition.qvel)
    assert {model.camera(index).name for index in range(model.ncam)} == {"fixed", "close"}


@pytest.mark.parametrize("task", TASKS)
def test_the_stored_model_opens_without_us(task, bare_engine):
    model = mujoco.MjModel.from_xml_path(str(asset_path(TASKS[task].asset)))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 100)
    assert np.isfinite(data.qpos).all()


@pytest.mark.parametrize("physics", ["mujoco", "analytic"])
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("task", NEW)
def test_a_copy_made_in_the_middle_of_an_episode_goes_on_identically(task, duplicate, physics):
    env = ours(task, physics=physics).unwrapped
    env.reset(seed=0)
    drawn = actions(task, 0, 40)
    for action in drawn[:20]:
        env.step(action)
    other = duplicate(env)
    for action in drawn[20:]:
        results = [one.step(action) for one in (env, other)]
        np.testing.assert_array_equal(results[0][0], results[1][0])
        np.testing.assert_array_equal(env.state, other.state)
        assert results[0][1:] == results[1][1:]


@pytest.mark.parametrize("task", NEW)
def test_rendering_leaves_the_episode_alone(task):
    pair = [ours(task, render_mode="rgb_array", width=32, height=32).unwrapped for _ in range(2)]
    for env in pair:
        env.reset(seed=0)
    for action in actions(task, 0, 10):
        results = [env.step(action) for env in pair]
        assert results[0][4] == results[1][4]
        np.testing.assert_array_equal(pair[0].state, pair[1].state)
        pair[1].render()
        np.testing.assert_array_equal(pair[0].data.act, pair[1].data.act)
    for env in pair:
        env.close()
