"""Every constructor of vectors takes the same arguments, and makes what Gymnasium's loop over single ones makes."""

import functools
import itertools

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import codrl_mj
from codrl_mj import EnvConfig, make, make_sb3_vec_env, make_vec, suite
from codrl_mj.envs import ActuatedVectorEnv, SerialVectorEnv
from tests.envs.faces import arguments
from tests.envs.vectors import assert_equal_episodes, assert_same, looped, random_actions

ID, COUNT = "codrl_mj/CartPole-v0", 2
LIMITED = {"max_episode_steps": 4}
ARGUMENTS = {
    "nothing": {},
    "threads": {"num_threads": 2},
    "next step": {"autoreset_mode": "NextStep"},
    "disabled": {"autoreset_mode": AutoresetMode.DISABLED},
    "actuator": {"actuator": "weaker"},
    "mapping": {"actuator": {"motor": {"inductance": 0.3}}},
    "pattern": {"actuator": {".*": "weak"}},
    "one for each": {"actuator": ["weak", "weaker"]},
    "one for each, drawn": {
        "actuator": ["weak", "weaker"],
        "randomize": {"motor.resistance": "uniform(1, 2)"},
    },
    "rendered": {"render_mode": "rgb_array", "width": 64, "height": 48, "num_threads": 1},
    "options": {"options": {"center_radius": 0.01}},
    "option": {"center_radius": 0.01, "sutton_barto_reward": True},
    "everything": arguments("cartpole", "everything"),
}
VECTORS = {
    "name": functools.partial(make_vec, "cartpole"),
    "id": functools.partial(make_vec, ID),
    "configuration": lambda num_envs, **given: make_vec(EnvConfig("cartpole"), num_envs, **given),
    "its method": lambda num_envs, **given: EnvConfig("cartpole").make_vec(num_envs, **given),
    "class": lambda num_envs, **given: ActuatedVectorEnv(
        num_envs, "cartpole", **{"autoreset_mode": "SameStep", **given}
    ),
    "Gymnasium": lambda num_envs, **given: gymnasium.make_vec(
        ID, num_envs, **{"autoreset_mode": "SameStep", **given}
    ),
    "Stable-Baselines3, name": lambda num_envs, **given: make_sb3_vec_env(
        "cartpole", num_envs, **given
    ),
    "Stable-Baselines3, configuration": lambda num_envs, **given: make_sb3_vec_env(
        EnvConfig("cartpole"), num_envs, **given
    ),
}
SINGLE = {
    "name": functools.partial(make, "cartpole"),
    "configuration": lambda **given: make(EnvConfig("cartpole"), **given),
    "its method": lambda **given: EnvConfig("cartpole").make(**given),
    "dm_control": lambda **given: suite.load("cartpole", **given).env,
}


def of_gymnasium(given):
    """Gymnasium's loop over environments with the same arguments."""
    single = {
        name: value
        for name, value in given.items()
        if name not in ("num_threads", "autoreset_mode")
    }
    mode = AutoresetMode(given.get("autoreset_mode", "SameStep"))
    return looped("cartpole", COUNT, mode, **LIMITED, **single)


@pytest.mark.parametrize("given", ARGUMENTS.values(), ids=ARGUMENTS)
def test_every_argument_does_the_same_in_every_constructor_of_vectors(given):
    same_step = AutoresetMode(given.get("autoreset_mode", "SameStep")) == AutoresetMode.SAME_STEP
    for name, constructor in VECTORS.items():
        if name.startswith("Stable") and not same_step:
            with pytest.raises(ValueError, match=r"autoreset_mode = '.*': must be 'SameStep'"):
                constructor(COUNT, **LIMITED, **given)
            continue
        made = constructor(COUNT, **LIMITED, **given)
        batch = getattr(made, "env", made).unwrapped
        assert isinstance(batch, ActuatedVectorEnv), name
        assert batch.render_mode == given.get("render_mode")
        assert assert_equal_episodes(batch, of_gymnasium(given), 9).sum() >= 2, name
        if batch.render_mode:
            assert [image.shape for image in batch.render()] == [(48, 64, 3)] * COUNT
        made.close()


SINGLE_ARGUMENTS = {
    name: given
    for name, given in ARGUMENTS.items()
    if not {"num_threads", "autoreset_mode"} & given.keys() and "one for each" not in name
}


@pytest.mark.parametrize("given", SINGLE_ARGUMENTS.values(), ids=SINGLE_ARGUMENTS)
def test_every_argument_does_the_same_in_every_constructor_of_one(given):
    def walked(env):
        env.action_space.seed(1)
        steps = [env.reset(seed=5), *(env.step(env.action_space.sample()) for _ in range(4))]
        env.close()
        assert steps[-1][3]
        return tuple((seen, *map(np.asarray, ends), info) for seen, *ends, info in steps)

    expected = walked(gymnasium.make(ID, **LIMITED, **given))
    for name, constructor in SINGLE.items():
        for got, want in zip(walked(constructor(**LIMITED, **given)), expected, strict=True):
            assert_same(got[:-1], want[:-1], name)


@pytest.mark.parametrize("mode", [mode.value for mode in AutoresetMode])
def test_one_by_one_too_an_episode_that_ended_is_reset_when_it_was_asked_for(mode):
    given = {"physics": "analytic", "actuator": "weak", "max_episode_steps": 4}
    for make_serial in VECTORS["name"], VECTORS["configuration"]:
        envs = make_serial(COUNT, autoreset_mode=mode, **given)
        assert isinstance(envs, SerialVectorEnv)
        assert assert_equal_episodes(envs, looped("cartpole", COUNT, mode, **given), 20).sum() > 4
        envs.close()


def test_a_snapshot_knows_which_of_the_serial_environments_are_to_be_reset():
    envs, other = (
        make_vec("cartpole", 2, physics="analytic", autoreset_mode="NextStep", **LIMITED)
        for _ in "12"
    )
    generator = np.random.default_rng(0)
    envs.reset(seed=0)
    for _ in range(4):
        envs.step(random_actions(envs, generator))
    other.restore(envs.snapshot())
    for _ in range(6):
        actions = random_actions(envs, generator)
        assert_same(other.step(actions), envs.step(actions))


@pytest.mark.parametrize(
    "env", ["Reacher-v5", EnvConfig("Reacher-v5"), functools.partial(gymnasium.make, "Reacher-v5")]
)
def test_what_is_stepped_one_by_one_has_no_threads_and_says_so(env):
    with pytest.raises(ValueError, match=r"num_threads = 2: must be 0 or 1 here: .*leave it out"):
        make_vec(env, 1, "lag", num_threads=2)
    envs = make_vec(env, 1, "lag", num_threads=1, autoreset_mode="Disabled", max_episode_steps=5)
    assert envs.autoreset_mode == AutoresetMode.DISABLED
    assert envs.envs[0].get_wrapper_attr("motors")[0] == codrl_mj.actuators.Lag()
    envs.close()


def test_a_window_is_the_only_thing_that_makes_a_task_slow_and_that_is_said():
    with pytest.warns(
        UserWarning,
        match="render_mode = 'human': 1 environments of pendulum are stepped one by one",
    ):
        envs = make_vec("pendulum", 1, render_mode="human")
    assert isinstance(envs, SerialVectorEnv)
    envs.close()


def test_none_leaves_the_time_limit_of_a_task_as_it_is():
    made = (
        make_vec("cartpole", 1, max_episode_steps=None),
        make_sb3_vec_env("cartpole", 1, max_episode_steps=None).env,
    )
    assert [env.max_episode_steps for env in made] == [gymnasium.spec(ID).max_episode_steps] * 2


def test_actuators_stand_third_in_every_factory():
    for env, pattern in itertools.product(
        ("pendulum", EnvConfig("pendulum", "weak")), (".*", "motor")
    ):
        given = env, 2, {pattern: "lag"}
        for batch in make_vec(*given), make_sb3_vec_env(*given).env:
            assert batch.setup.config.actuator == codrl_mj.actuators.Lag()
    with pytest.raises(
        ValueError, match=r"the function makes environments that have their motors: leave it out"
    ):
        make_sb3_vec_env(functools.partial(make, "Reacher-v5", "lag"), 1, "lag")


class Arm(gymnasium.Env):
    """An environment whose class has an attribute that is called like the method of a configuration."""

    make = "brand"

    def __new__(cls, **options):
        """Be the reacher, whatever the class is called."""
        return gymnasium.make("Reacher-v5", **options)


def test_a_class_is_called_whatever_attributes_it_has():
    with make(Arm, "lag") as env:
        assert env.get_wrapper_attr("motors")[0] == codrl_mj.actuators.Lag()


def test_a_field_that_only_tasks_have_is_an_argument_elsewhere():
    class Timed:
        """Takes what a task calls its integration step."""

        def __new__(cls, timestep=0.0, **options):
            assert timestep == 0.5
            return gymnasium.make("Reacher-v5", **options)

    gymnasium.register("Timed-v0", Timed, max_episode_steps=5)
    try:
        for env in ("Timed-v0", EnvConfig("Timed-v0")):
            make_vec(env, 1, "lag", timestep=0.5).close()
            make(env, "lag", timestep=0.5).close()
        suite.load("Timed-v0", actuator="lag", timestep=0.5).close()
    finally:
        gymnasium.registry.pop("Timed-v0")


@pytest.mark.parametrize("name", ["frame_skip", "options"])
def test_options_of_an_environment_of_others_are_taken_alike(name):
    given = {"frame_skip": 7} if name == "frame_skip" else {"options": {"frame_skip": 7}}
    for env in "Reacher-v5", EnvConfig("Reacher-v5"):
        one, many = make(env, "lag", **given), make_vec(env, 1, "lag", **given)
        assert {one.unwrapped.frame_skip, many.envs[0].unwrapped.frame_skip} == {7}
        one.close(), many.close()


def test_another_task_given_over_a_configuration_is_that_task():
    assert make(EnvConfig("pendulum", "weak"), task="cartpole", actuator="lag").spec.id == ID


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: make_vec("pendulum", 3, ["lag", "lag"]), "2 actuators for 3 environments"),
        (
            lambda: make("pendulum", ["lag", "lag"]),
            (
                r"got 2 actuators, but pendulum has 1 motor \(motor\); a list .* is for"
                r" codrl_mj.make_vec"
            ),
        ),
        (
            lambda: make_vec("pendulum", 2, actuater="lag"),
            "unknown option 'actuater' of pendulum: did you mean 'actua",
        ),
        (
            lambda: EnvConfig("cartpole", options=3),
            "options = 3: must be a mapping of option names to values",
        ),
        (
            lambda: make("cartpole", options="ab"),
            "options = 'ab': must be a mapping of option names to values",
        ),
        (
            lambda: suite.load(make),
            "must be a task's name or an EnvConfig; others go into DmEnvironment",
        ),
    ],
)
def test_what_does_not_go_is_refused_by_its_name(act, message):
    with pytest.raises(ValueError, match=message):
        act()
