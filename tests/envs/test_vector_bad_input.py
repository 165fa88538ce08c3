"""What the vector environment refuses: the message names the environment, and the others keep their state."""

import ctypes
import re

import gymnasium
import mujoco
import numpy as np
import pytest

from codrl_mj.actuators import Actuator, CurrentLoop, Motor
from codrl_mj.engine import CallbackInUseError
from codrl_mj.envs import ActuatedVectorEnv
from codrl_mj.physics import SimulationDivergedError
from codrl_mj.tasks import TASKS
from tests.engine.models import changed
from tests.envs.vectors import MODES, assert_same, batched, looped, random_actions
from tests.matrix import but
from tests.tasks.faces import REBUILT

every_task = pytest.mark.parametrize("task", TASKS)
CONTINUOUS = ("pendulum", "mountain_car_continuous")
STABLE = Actuator(Motor(), CurrentLoop(kp=1.0))
WILD = Actuator(Motor(), CurrentLoop(kp=1000.0, max_voltage=float("inf")))

BAD = {
    "none at all": ({"num_envs": 0}, "num_envs = 0: must be an integer >= 1"),
    "negative": ({"num_envs": -3}, "num_envs = -3: must be an integer >= 1"),
    "half": ({"num_envs": 1.5}, "num_envs = 1.5: must be an integer >= 1"),
    "bool": ({"num_envs": True}, "num_envs = True: must be an integer >= 1"),
    "limit": ({"max_episode_steps": 0}, "max_episode_steps = 0: must be an integer >= 1"),
    "half a limit": ({"max_episode_steps": 1.5}, "max_episode_steps = 1.5: must be an integer >= 1"),
    "bool as a limit": ({"max_episode_steps": True}, "max_episode_steps = True: must be an integer >= 1"),
    "threads": ({"num_threads": -1}, "num_threads = -1: must be an integer >= 0"),
    "threads type": ({"num_threads": "2"}, "num_threads = '2': must be an integer >= 0"),
    "physics": ({"physics": "analytic"}, "one Gymnasium environment at a time: use vectorization_mode='sync' for it"),
    "mode": ({"autoreset_mode": "Sometimes"}, "'Sometimes' is not a valid AutoresetMode"),
    "task": ({"task": "pendulm"}, "unknown task 'pendulm': did you mean 'pendulum'"),
    "render mode": ({"render_mode": "human"}, "render_mode = 'human': must be one of None, rgb_array"),
    "camera": ({"render_mode": "rgb_array", "camera": "far"}, "camera = 'far'"),
    "option": ({"centre_radius": 0.1}, "unknown option 'centre_radius' of pendulum: it has none"),
    "integrator": ({"integrator": "rk45"}, "integrator = 'rk45': pendulum has semi-implicit"),
    "too few actuators": ({"actuator": [STABLE] * 2}, "2 actuators for 3 environments: there must be one for each"),
    "too many actuators": ({"actuator": [STABLE] * 4}, "4 actuators for 3 environments: there must be one for each"),
    "no actuators": ({"actuator": []}, "0 actuators for 3 environments: there must be one for each"),
    "not an actuator": ({"actuator": [STABLE, "ideal", STABLE]}, "actuator[1] = 'ideal': must be an Actuator"),
    "unknown name": (
        {"actuator": ["weak", "weka", "weak"]},
        "actuator[1]: unknown actuator 'weka': did you mean 'weak'?",
    ),
    "a number": ({"actuator": ["weak", "weak", 3]}, "actuator[2]: actuator = 3: must be a name"),
    "two families": ({"actuator": ["weak", "lag", "weak"]}, "actuators of several families (Actuator, Lag)"),
    "none among others": ({"actuator": ["weak", None, "weak"]}, "actuator[1] = None: must be an Actuator"),
    "unstable": ({"actuator": WILD}, "unstable at a step of 0.05 s: spectral radius"),
    "one unstable": ({"actuator": [STABLE, STABLE, WILD]}, "actuator[2]: "),
    "voltage for each": (
        {"actuator": [STABLE] * 3, "action": "voltage"},
        "action = 'voltage': with an actuator for each environment only 'force'",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_argument_is_refused(case):
    arguments, message = BAD[case]
    with pytest.raises(ValueError, match=re.escape(message)):
        ActuatedVectorEnv(**{"num_envs": 3, "task": "pendulum", **arguments})


def test_an_unstable_actuator_among_others_is_refused_with_its_radius():
    with pytest.raises(ValueError, match=r"^actuator\[2\]: .*spectral radius"):
        ActuatedVectorEnv(3, "pendulum", [STABLE, STABLE, WILD])


def test_a_foreign_callback_is_refused_at_the_start_and_at_a_reset(bare_engine):
    foreign = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(lambda *_: None)
    env = ActuatedVectorEnv(2, "pendulum")
    env.reset(seed=0)
    mujoco.set_mjcb_control(None)
    mujoco.set_mjcb_control(foreign)
    with pytest.raises(CallbackInUseError, match="mjcb_control is already set"):
        ActuatedVectorEnv(2, "pendulum")
    with pytest.raises(CallbackInUseError, match="mjcb_control is already set"):
        env.reset(seed=0)
    mujoco.set_mjcb_control(None)
    assert_same(env.reset(seed=0), ActuatedVectorEnv(2, "pendulum").reset(seed=0))


# -- actions ------------------------------------------------------------------------------------------------


def _everything(env):
    return {name: value.copy() for name, value in env.unwrapped.snapshot().items()}


def _wrong_actions(env):
    """Batches that are refused, with the index of the environment to be named, or None."""
    good = random_actions(env, np.random.default_rng(0))
    wrong = [(good[:3], None), (np.concatenate([good, good]), None), (good[0], None), (None, None), ("left", None)]
    if isinstance(env.single_action_space, gymnasium.spaces.Discrete):
        wrong += [(good.astype(float), None), (good[:, None], None), (good > 0, None)]
        values = [-1, env.single_action_space.n, np.iinfo(np.int64).max]
    else:
        wrong += [(np.ones((4, 1), int), None), (good[:, 0], None), (np.ones((4, 2), np.float32), None)]
        values = [np.nan]
    for row, value in zip((2, 0, 3), values * 3, strict=False):
        bad = good.copy()
        bad[row] = value
        wrong.append((bad, row))
    return wrong


@every_task
@pytest.mark.parametrize("mode", MODES)
def test_bad_actions_are_refused_before_anything_is_stepped(task, mode):
    env, control = batched(task, 4, mode), batched(task, 4, mode)
    generator = np.random.default_rng(1)
    for one in (env, control):
        one.reset(seed=0)
    for _ in range(2):
        actions = random_actions(env, generator)
        assert_same(env.step(actions), control.step(actions))
    before = _everything(env)
    for actions, row in _wrong_actions(env):
        with pytest.raises(ValueError, match="actions" if row is None else rf"actions\[{row}\] .*environment {row}\)"):
            env.step(actions)
        assert_same(_everything(env), before)
    actions = random_actions(env, generator)
    assert_same(env.step(actions), control.step(actions))


@pytest.mark.parametrize("task", CONTINUOUS)
def test_infinite_and_float64_actions_saturate_as_in_a_single_environment(task):
    ours, theirs = batched(task, 4), looped(task, 4, disable_env_checker=True)
    for env in (ours, theirs):
        env.reset(seed=0)
    for values in ([np.inf, -np.inf, 1e300, -3.0], [0.1, 0.2, 0.3, -0.4]):
        actions = np.array(values).reshape(4, 1)
        assert_same(ours.step(actions), theirs.step(actions))


def test_an_environment_that_ended_is_not_stepped_again_unless_reset():
    env = batched("cartpole", 3, "Disabled", max_episode_steps=2)
    env.reset(seed=0)
    env.step(np.zeros(3, int))
    env.reset(options={"reset_mask": np.array([True, False, True])})
    *_, truncated, _ = env.step(np.zeros(3, int))
    np.testing.assert_array_equal(truncated, [False, True, False])
    before = _everything(env)
    with pytest.raises(RuntimeError, match="environment 1 has ended and was not reset"):
        env.step(np.zeros(3, int))
    assert_same(_everything(env), before)
    env.reset(options={"reset_mask": truncated})
    env.step(np.zeros(3, int))


# -- resets -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": [1, 2]}, "seed: 2 seeds for 3 environments"),
        ({"seed": [1, 2, 3, 4]}, "seed: 4 seeds for 3 environments"),
        ({"options": {"reset_mask": np.ones(2, bool)}}, "must be a bool array of shape (3,) with a True in it"),
        ({"options": {"reset_mask": np.ones(3)}}, "must be a bool array of shape (3,)"),
        ({"options": {"reset_mask": [True] * 3}}, "must be a bool array of shape (3,)"),
        ({"options": {"reset_mask": np.zeros(3, bool)}}, "with a True in it"),
        ({"options": {"low": 0.5, "high": -0.5}}, "low"),
        ({"options": {"low": "left"}}, "left"),
        ({"seed": -1}, "-1"),
    ],
)
def test_a_bad_reset_is_refused_and_changes_nothing(arguments, message):
    env = ActuatedVectorEnv(3, "cartpole")
    env.reset(seed=0)
    env.step(np.ones(3, int))
    before = _everything(env)
    with pytest.raises((ValueError, gymnasium.error.Error), match=re.escape(message)):
        env.reset(**arguments)
    assert_same(_everything(env), before)


# -- divergence ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", [task for task in REBUILT if task != "cartpole"])  # whose episode would end first
@pytest.mark.parametrize("mode", MODES)
def test_a_diverging_environment_is_named_and_the_others_go_on_once_it_is_reset(task, mode, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the engine writes a log
    arguments = {"inner_steps": 10 if task == "acrobot" else 1}
    gentle = Actuator(Motor(inductance=2.0), CurrentLoop(kp=0.5))  # stable at a step of 1 s
    wild = changed(WILD, kp=15.0 if task == "acrobot" else 100.0)  # lost after a step or two
    actuators = [gentle, gentle, wild, gentle]
    env = batched(task, 4, mode, actuator=actuators, allow_unstable=True, max_episode_steps=400, **arguments)
    others = np.array([True, True, False, True])
    env.reset(seed=0)
    space = env.single_action_space
    actions = np.full(4, space.n - 1) if hasattr(space, "n") else np.repeat(space.high[None], 4, axis=0)

    def run():
        for _ in range(400):
            *_, terminated, truncated, _ = env.step(actions)
            if mode == "Disabled" and (terminated | truncated).any():
                env.reset(options={"reset_mask": terminated | truncated})

    with pytest.raises(SimulationDivergedError, match=rf"^{task}: 1 of 4 simulations diverged; environment 2 at t = "):
        run()
    state = env.unwrapped.state
    assert np.isfinite(state[others]).all()
    with pytest.raises(SimulationDivergedError, match="environment 2"):
        env.step(actions)  # until it is reset
    state = env.unwrapped.state
    env.reset(seed=[None, None, 7, None], options={"reset_mask": ~others})
    np.testing.assert_array_equal(env.unwrapped.state[others], state[others])
    observations, *_ = env.step(actions)
    assert np.isfinite(observations).all()
    # the rest of its episode is that of an environment of its own
    fresh = batched(task, 1, mode, actuator=[wild], allow_unstable=True, **arguments)
    fresh.reset(seed=7)
    np.testing.assert_array_equal(fresh.step(actions[:1])[0][0], observations[2])


@pytest.mark.parametrize("task", but(["pendulum", "cartpole"], TASKS))
def test_time_goes_on_for_the_others_when_one_diverges(task, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the engine writes a log
    env = ActuatedVectorEnv(2, task, max_episode_steps=5)
    env.reset(seed=0)
    actions = random_actions(env, np.random.default_rng(0))
    env.step(actions)
    saved = env.snapshot()
    saved["physics"][1, :] = np.nan
    env.restore(saved)
    with pytest.raises(SimulationDivergedError, match="environment 1"):
        env.step(actions)
    env.reset(options={"reset_mask": np.array([False, True])})
    truncations = [env.step(actions)[3].tolist() for _ in range(3)]
    assert truncations == [[False, False], [False, False], [True, False]]
