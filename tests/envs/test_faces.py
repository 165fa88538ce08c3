"""Whatever face an environment has, it can be copied, stored, repeated, and written over, and goes on the same."""

import copy
import pickle
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from safetensors.numpy import load, load_file, save, save_file

from codrl_mj import suite
from codrl_mj.envs import ActuatedEnv
from codrl_mj.tasks import TASKS
from tests.envs.faces import (
    FACES,
    LIMITED,
    PHYSICS,
    SETUPS,
    arguments,
    arrays,
    begun,
    made,
    plain,
    run,
)
from tests.envs.vectors import assert_same
from tests.tasks.faces import every_rebuilt

every_face = pytest.mark.parametrize("face", FACES)
every_setup = pytest.mark.parametrize("setup", SETUPS)


@every_face
@every_setup
@every_rebuilt
def test_copies_and_restored_snapshots_go_on_as_the_original(face, task, setup):
    env, fresh, used = (made(face, task, setup) for _ in range(3))
    begun(used, 99)
    for steps in (None, 23):  # before the first reset, and in an episode
        if steps:
            begun(env, 5)
            run(env, steps, seed=0)
        kept = env.snapshot()
        twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env)), fresh, used]
        for twin in (fresh, used):
            twin.restore(load(save(kept)))
        following = []
        for one in (env, *twins):
            assert_same(one.snapshot(), kept)  # which moves with none of those before
            if (
                steps is None and face == "serial, analytic"
            ):  # Gymnasium's time limit insists on a reset
                begun(one)
            following.append(run(one, 60, seed=1))
        for other in following[1:]:
            assert_same(other, following[0])
        if face == "one":  # one model, the twin's own: changing it changes the twin
            assert all(twin.model is twin.data.model is not env.model for twin in twins)


@every_face
@every_rebuilt
def test_what_is_returned_and_given_is_nobody_elses(face, task):
    env, control = (made(face, task, "everything") for _ in range(2))
    for one in (env, control):
        begun(one, 2)
    assert_same(run(env, 45, seed=0, vandal=True), run(control, 45, seed=0))


@every_face
@every_rebuilt
def test_a_seed_repeats_and_another_differs(face, task):
    env = made(face, task, "force")
    first, again, other = ((plain(begun(env, seed)), run(env, 30, seed=0)) for seed in (3, 3, 4))
    assert_same(again, first)
    with pytest.raises(AssertionError):
        assert_same(other, first)


@every_rebuilt
@every_setup
def test_both_physics_tell_the_same_story(task, setup):
    """Over the first steps, before chaos: states, rewards, ends and signals."""
    given = arguments(task, setup, "analytic")
    pair = [ActuatedEnv(task, physics=physics, **given) for physics in PHYSICS]
    for one, other in zip(
        *(arrays(plain((begun(env, 7), run(env, 15, seed=0)))) for env in pair), strict=True
    ):
        rounding = 1e-6 if one.dtype == np.float32 else 1e-9
        np.testing.assert_allclose(one, other, rtol=rounding, atol=rounding)


@every_rebuilt
@every_setup
def test_dm_control_has_the_episodes_of_a_single_environment(task, setup):
    given = arguments(task, setup) | LIMITED
    theirs = suite.load(task, task_kwargs={"random": 4}, **given)
    ours = gymnasium.make(TASKS[task].env_id, disable_env_checker=True, **given)
    for seed in (4, None):
        step, (seen, info) = theirs.reset(), ours.reset(seed=seed)
        np.testing.assert_array_equal(np.concatenate([*step.observation.values()]), seen)
        assert theirs.randomization == info.get("randomization", {})
        while not step.last():
            action = ours.action_space.sample()
            step, (seen, reward, terminated, truncated, info) = (
                theirs.step(action),
                ours.step(action),
            )
            np.testing.assert_array_equal(np.concatenate([*step.observation.values()]), seen)
            assert (step.reward, step.last(), theirs.info) == (
                reward,
                terminated or truncated,
                info,
            )
            np.testing.assert_array_equal(theirs.state, ours.unwrapped.state)


@pytest.mark.matrix
def test_another_process_goes_on_as_the_original(tmp_path):
    expected = {}
    for task in ("cartpole", "mountain_car"):
        env = made("Stable-Baselines3", task, "everything")
        begun(env, 3)
        save_file(env.snapshot(), tmp_path / f"{task}.before")
        run(env, 60, seed=1)
        expected[task] = env.snapshot()
    subprocess.run([sys.executable, "-m", "tests.envs.faces", str(tmp_path)], check=True)
    for task, values in expected.items():
        assert_same(load_file(tmp_path / f"{task}.after"), values, task)
