"""Every interface of an environment can be copied, stored and repeated, and continues the same."""

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
    make_face,
    plain,
    run,
    start_episode,
)
from tests.envs.vectors import assert_same
from tests.tasks.faces import every_rebuilt

every_face = pytest.mark.parametrize("face", FACES)
every_setup = pytest.mark.parametrize("setup", SETUPS)


@every_face
@every_setup
@every_rebuilt
def test_copies_and_restored_snapshots_continue_like_the_original(face, task, setup):
    env, fresh, used = (make_face(face, task, setup) for _ in range(3))
    start_episode(used, 99)
    # First before any reset, then in the middle of an episode.
    for steps in (None, 23):
        if steps:
            start_episode(env, 5)
            run(env, steps, seed=0)
        snapshot = env.snapshot()
        twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env)), fresh, used]
        for twin in (fresh, used):
            twin.restore(load(save(snapshot)))
        runs = []
        for resumed in (env, *twins):
            # The twins that ran before must not have changed this one.
            assert_same(resumed.snapshot(), snapshot)
            # Gymnasium's time limit cannot step before a first reset.
            if steps is None and face == "serial, analytic":
                start_episode(resumed)
            runs.append(run(resumed, 60, seed=1))
        for run_of_twin in runs[1:]:
            assert_same(run_of_twin, runs[0])
        # Each twin has a model of its own: changing it changes only the twin.
        if face == "one":
            assert all(twin.model is twin.data.model is not env.model for twin in twins)


@every_face
@every_rebuilt
def test_overwriting_returned_arrays_and_actions_changes_nothing(face, task):
    env, control = (make_face(face, task, "everything") for _ in range(2))
    for each_env in (env, control):
        start_episode(each_env, 2)
    assert_same(run(env, 45, seed=0, vandal=True), run(control, 45, seed=0))


@every_face
@every_rebuilt
def test_a_seed_repeats_and_another_differs(face, task):
    env = make_face(face, task, "force")
    first, again, other_run = (
        (plain(start_episode(env, seed)), run(env, 30, seed=0)) for seed in (3, 3, 4)
    )
    assert_same(again, first)
    with pytest.raises(AssertionError):
        assert_same(other_run, first)


@every_rebuilt
@every_setup
def test_both_physics_give_the_same_results(task, setup):
    """Compare states, rewards, ends and signals of the first steps, before chaos sets in."""
    options = arguments(task, setup, "analytic")
    pair = [ActuatedEnv(task, physics=physics, **options) for physics in PHYSICS]
    for values, expected in zip(
        *(arrays(plain((start_episode(env, 7), run(env, 15, seed=0)))) for env in pair), strict=True
    ):
        rounding = 1e-6 if values.dtype == np.float32 else 1e-9
        np.testing.assert_allclose(values, expected, rtol=rounding, atol=rounding)


@every_rebuilt
@every_setup
def test_dm_control_has_the_episodes_of_a_single_environment(task, setup):
    options = arguments(task, setup) | LIMITED
    theirs = suite.load(task, task_kwargs={"random": 4}, **options)
    ours = gymnasium.make(TASKS[task].env_id, disable_env_checker=True, **options)
    for seed in (4, None):
        step, (observation, info) = theirs.reset(), ours.reset(seed=seed)
        np.testing.assert_array_equal(np.concatenate([*step.observation.values()]), observation)
        assert theirs.randomization == info.get("randomization", {})
        while not step.last():
            action = ours.action_space.sample()
            step, (observation, reward, terminated, truncated, info) = (
                theirs.step(action),
                ours.step(action),
            )
            np.testing.assert_array_equal(np.concatenate([*step.observation.values()]), observation)
            assert (step.reward, step.last(), theirs.info) == (
                reward,
                terminated or truncated,
                info,
            )
            np.testing.assert_array_equal(theirs.state, ours.unwrapped.state)


@pytest.mark.matrix
def test_another_process_continues_like_the_original(tmp_path):
    expected = {}
    for task in ("cartpole", "mountain_car"):
        env = make_face("Stable-Baselines3", task, "everything")
        start_episode(env, 3)
        save_file(env.snapshot(), tmp_path / f"{task}.before")
        run(env, 60, seed=1)
        expected[task] = env.snapshot()
    subprocess.run([sys.executable, "-m", "tests.envs.faces", str(tmp_path)], check=True)
    for task, values in expected.items():
        assert_same(load_file(tmp_path / f"{task}.after"), values, task)
