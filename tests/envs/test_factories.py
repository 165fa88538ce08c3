"""Constructors of vectors accept the same arguments, and equal Gymnasium's loop."""

import functools
import itertools

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import codrl_mj
from codrl_mj import EnvConfig, make, make_sb3_vec_env, make_vec, suite
from codrl_mj.envs import ActuatedVectorEnv, SerialVectorEnv
from tests.conformance.environments import arguments
from tests.conformance.episodes import assert_same, random_actions
from tests.envs.vectors import assert_equal_episodes, looped

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
    "everything": arguments("cartpole", "randomized"),
}
VECTORS = {
    "name": functools.partial(make_vec, "cartpole"),
    "id": functools.partial(make_vec, ID),
    "configuration": lambda num_envs, **options: make_vec(
        EnvConfig("cartpole"), num_envs, **options
    ),
    "its method": lambda num_envs, **options: EnvConfig("cartpole").build_vec(num_envs, **options),
    "class": lambda num_envs, **options: ActuatedVectorEnv(
        num_envs, "cartpole", **{"autoreset_mode": "SameStep", **options}
    ),
    "Gymnasium": lambda num_envs, **options: gymnasium.make_vec(
        ID, num_envs, **{"autoreset_mode": "SameStep", **options}
    ),
    "Stable-Baselines3, name": lambda num_envs, **options: make_sb3_vec_env(
        "cartpole", num_envs, **options
    ),
    "Stable-Baselines3, configuration": lambda num_envs, **options: make_sb3_vec_env(
        EnvConfig("cartpole"), num_envs, **options
    ),
}
SINGLE = {
    "name": functools.partial(make, "cartpole"),
    "configuration": lambda **options: make(EnvConfig("cartpole"), **options),
    "its method": lambda **options: EnvConfig("cartpole").build(**options),
    "dm_control": lambda **options: suite.load("cartpole", **options).env,
}


def of_gymnasium(options):
    """Make Gymnasium's loop over environments with the same arguments."""
    single = {
        name: value
        for name, value in options.items()
        if name not in ("num_threads", "autoreset_mode")
    }
    mode = AutoresetMode(options.get("autoreset_mode", "SameStep"))
    return looped("cartpole", COUNT, mode, **LIMITED, **single)


@pytest.mark.parametrize("options", ARGUMENTS.values(), ids=ARGUMENTS)
def test_arguments_have_the_same_effect_in_every_constructor_of_vector_environments(options):
    same_step = AutoresetMode(options.get("autoreset_mode", "SameStep")) == AutoresetMode.SAME_STEP
    for name, constructor in VECTORS.items():
        if name.startswith("Stable") and not same_step:
            with pytest.raises(ValueError, match=r"autoreset_mode = '.*': must be 'SameStep'"):
                constructor(COUNT, **LIMITED, **options)
            continue
        vector_env = constructor(COUNT, **LIMITED, **options)
        batch = getattr(vector_env, "env", vector_env).unwrapped
        assert isinstance(batch, ActuatedVectorEnv), name
        assert batch.render_mode == options.get("render_mode")
        assert assert_equal_episodes(batch, of_gymnasium(options), 9).sum() >= 2, name
        if batch.render_mode:
            assert [image.shape for image in batch.render()] == [(48, 64, 3)] * COUNT
        vector_env.close()


SINGLE_ARGUMENTS = {
    name: options
    for name, options in ARGUMENTS.items()
    if not {"num_threads", "autoreset_mode"} & options.keys() and "one for each" not in name
}


@pytest.mark.parametrize("options", SINGLE_ARGUMENTS.values(), ids=SINGLE_ARGUMENTS)
def test_arguments_have_the_same_effect_in_every_constructor_of_a_single_environment(options):
    def episode(env):
        env.action_space.seed(1)
        steps = [env.reset(seed=5), *(env.step(env.action_space.sample()) for _ in range(4))]
        env.close()
        assert steps[-1][3]
        return tuple(
            (observation, *map(np.asarray, ends), info) for observation, *ends, info in steps
        )

    expected = episode(gymnasium.make(ID, **LIMITED, **options))
    for name, constructor in SINGLE.items():
        for outcome, expected_outcome in zip(
            episode(constructor(**LIMITED, **options)), expected, strict=True
        ):
            assert_same(outcome[:-1], expected_outcome[:-1], name)


@pytest.mark.parametrize("mode", [mode.value for mode in AutoresetMode])
def test_serial_environments_reset_in_the_requested_autoreset_mode(mode):
    options = {"physics": "analytic", "actuator": "weak", "max_episode_steps": 4}
    for make_serial in VECTORS["name"], VECTORS["configuration"]:
        envs = make_serial(COUNT, autoreset_mode=mode, **options)
        assert isinstance(envs, SerialVectorEnv)
        assert assert_equal_episodes(envs, looped("cartpole", COUNT, mode, **options), 20).sum() > 4
        envs.close()


def test_a_snapshot_knows_which_serial_environments_must_be_reset():
    envs, other_envs = (
        make_vec("cartpole", 2, physics="analytic", autoreset_mode="NextStep", **LIMITED)
        for _ in "12"
    )
    generator = np.random.default_rng(0)
    envs.reset(seed=0)
    for _ in range(4):
        envs.step(random_actions(envs, generator))
    other_envs.restore(envs.snapshot())
    for _ in range(6):
        actions = random_actions(envs, generator)
        assert_same(other_envs.step(actions), envs.step(actions))


@pytest.mark.parametrize(
    "env", ["Reacher-v5", EnvConfig("Reacher-v5"), functools.partial(gymnasium.make, "Reacher-v5")]
)
def test_raises_if_serial_environments_get_several_threads(env):
    with pytest.raises(ValueError, match=r"num_threads = 2: must be 0 or 1: .*leave it out"):
        make_vec(env, 1, "lag", num_threads=2)
    envs = make_vec(env, 1, "lag", num_threads=1, autoreset_mode="Disabled", max_episode_steps=5)
    assert envs.autoreset_mode == AutoresetMode.DISABLED
    assert envs.envs[0].get_wrapper_attr("motors")[0] == codrl_mj.actuators.Lag()
    envs.close()


def test_warns_if_a_window_makes_a_task_step_one_by_one():
    with pytest.warns(
        UserWarning,
        match="render_mode = 'human': 1 environments of pendulum are stepped one by one",
    ):
        envs = make_vec("pendulum", 1, render_mode="human")
    assert isinstance(envs, SerialVectorEnv)
    envs.close()


def test_a_time_limit_of_none_selects_the_task_s_own():
    vector_envs = (
        make_vec("cartpole", 1, max_episode_steps=None),
        make_sb3_vec_env("cartpole", 1, max_episode_steps=None).env,
    )
    assert [env.max_episode_steps for env in vector_envs] == [
        gymnasium.spec(ID).max_episode_steps
    ] * 2


def test_the_actuator_is_the_third_argument_of_every_vector_factory():
    for env, pattern in itertools.product(
        ("pendulum", EnvConfig("pendulum", "weak")), (".*", "motor")
    ):
        factory_arguments = env, 2, {pattern: "lag"}
        for batch in make_vec(*factory_arguments), make_sb3_vec_env(*factory_arguments).env:
            assert batch.setup.config.actuator == codrl_mj.actuators.Lag()
    with pytest.raises(
        ValueError, match=r"the function makes environments that have their motors: leave it out"
    ):
        make_sb3_vec_env(functools.partial(make, "Reacher-v5", "lag"), 1, "lag")


class Arm(gymnasium.Env):
    """Environment whose class attribute has the name of a configuration's method."""

    make = "brand"

    def __new__(cls, **options):
        """Make a Reacher, whatever the name of the class."""
        return gymnasium.make("Reacher-v5", **options)


def test_a_class_with_an_attribute_make_is_still_called():
    with make(Arm, "lag") as env:
        assert env.get_wrapper_attr("motors")[0] == codrl_mj.actuators.Lag()


def test_a_field_that_only_tasks_have_is_an_option_of_other_environments():
    class Timed:
        """Environment with an argument that is a field's name."""

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
def test_options_of_a_third_party_environment_are_accepted_by_name_and_as_mapping(name):
    options = {"frame_skip": 7} if name == "frame_skip" else {"options": {"frame_skip": 7}}
    for env in "Reacher-v5", EnvConfig("Reacher-v5"):
        single, vector_env = make(env, "lag", **options), make_vec(env, 1, "lag", **options)
        assert {single.unwrapped.frame_skip, vector_env.envs[0].unwrapped.frame_skip} == {7}
        single.close(), vector_env.close()


def test_the_task_of_a_configuration_can_be_replaced():
    assert make(EnvConfig("pendulum", "weak"), task="cartpole", actuator="lag").spec.id == ID


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make_vec("pendulum", 3, ["lag", "lag"]), "got 2 actuators for 3 environments"),
        (
            lambda: make("pendulum", ["lag", "lag"]),
            (
                r"got 2 actuators, but pendulum has 1 motor \(motor\); codrl_mj\.make_vec takes a"
                r" list with an actuator for each environment"
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
            "must be a task's name or an EnvConfig; wrap other environments in DmEnvironment",
        ),
    ],
)
def test_raises_for_wrong_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()
