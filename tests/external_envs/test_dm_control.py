"""`make_dm_control`: dm_control's environments with motors."""

import gymnasium as gym
import numpy as np
import pytest
from dm_control import composer, manipulation, suite
from dm_control.locomotion.examples import basic_cmu_2019, basic_rodent_2020

import codrl_mj
from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Drive, Motor, TorqueSpeed
from codrl_mj.catalogue import motor_entry
from tests.matrix import matrix_params

IDEAL = {".*": "ideal"}
DOMAINS = sorted(
    {domain: f"{domain}/{task}" for domain, task in reversed(suite.ALL_TASKS)}.values()
)
"""One task of each domain of the suite."""


def _inputs(env, steps):
    spec = env.action_spec()
    low = np.where(np.isfinite(spec.minimum), spec.minimum, -1.0)
    high = np.where(np.isfinite(spec.maximum), spec.maximum, 1.0)
    return np.random.default_rng(0).uniform(low, high, (steps, *spec.shape))


def _assert_same(ours, original, steps):
    for index, action in enumerate([None, *_inputs(original, steps)]):
        timestep, expected = (
            env.reset() if action is None else env.step(action) for env in (ours, original)
        )
        assert timestep[:3] == expected[:3], index
        assert timestep.observation.keys() == expected.observation.keys()
        for name, value in expected.observation.items():
            np.testing.assert_array_equal(
                timestep.observation[name], value, err_msg=f"{name}, step {index}"
            )
    return expected


@pytest.mark.parametrize("name", matrix_params(("cheetah/run", "cartpole/balance"), DOMAINS))
def test_ideal_motors_do_not_change_whole_episodes(name):
    """Step 1001 times: 1000 are the suite's longest episodes, and shorter ones start again."""
    ours = codrl_mj.make_dm_control(name, IDEAL, task_kwargs={"random": 1})
    original = suite.load(*name.split("/"), task_kwargs={"random": 1})
    assert len(codrl_mj.engine.motors(ours.mujoco[0])) == original.physics.model.nactuator > 0
    for specification in ("action_spec", "observation_spec", "reward_spec", "discount_spec"):
        assert getattr(ours, specification)() == getattr(original, specification)()
    _assert_same(ours, original, 1001)


REBUILT = {
    "reach": lambda: manipulation.load("reach_duplo_features", seed=1),
    "rodent": lambda: basic_rodent_2020.rodent_run_gaps(random_state=np.random.RandomState(1)),
    "humanoid": lambda: basic_cmu_2019.cmu_humanoid_run_walls(
        random_state=np.random.RandomState(1)
    ),
}


@pytest.mark.parametrize("name", matrix_params(("reach",), REBUILT))
def test_environments_that_rebuild_their_model_at_resets_have_motors_in_each(name):
    ours, original = codrl_mj.make_dm_control(REBUILT[name], IDEAL), REBUILT[name]()
    assert isinstance(original, composer.Environment)
    models = []
    for _ in range(2):
        _assert_same(ours, original, 10)
        models.append(ours.mujoco[0])
        assert len(codrl_mj.engine.motors(models[-1])) == models[-1].nactuator
        assert len(ours.signals()["actual_force"]) == models[-1].nactuator
    assert models[0] is not models[1]


def test_signals_are_those_of_the_last_completed_step():
    """Use `mj_step2` before `mj_step1`: the speed after a step determines the next first force."""
    line = TorqueSpeed(stall_torque=1.5, no_load_speed=5.0, max_torque=1.0)
    env = codrl_mj.make_dm_control("cartpole/swingup", {"slide": line}, task_kwargs={"random": 0})
    env.reset()
    gear, saturated = env.mujoco[0].actuator_gear[0, 0], []
    for action in np.repeat(_inputs(env, 30), 5, axis=0):
        speed = gear * env.physics.data.qvel[0]
        env.step(action)
        upper, lower = (np.clip(1.5 * (sign - speed / 5.0), -1.0, 1.0) for sign in (1.0, -1.0))
        signals = env.signals()
        assert signals["desired_force"] == action[0]
        assert signals["actual_force"] == pytest.approx(
            np.clip(action[0], lower, upper), rel=1e-12, abs=1e-13
        )
        assert signals["saturated"] is bool(signals["actual_force"] != action[0])
        saturated.append(signals["saturated"])
    assert 10 < sum(saturated) < 140


def test_noise_differs_between_episodes_and_repeats_with_its_seed():
    noisy = DCMotorActuator(
        Motor(resistance=1.0, inductance=0.05, torque_constant=0.8, back_emf_constant=0.01),
        CurrentLoop(kp=0.5, ki=2.0, max_voltage=4.0, current_noise=0.1),
    )
    runs = []
    for seed in (1, 1, 2):
        env = codrl_mj.make_dm_control(
            "pendulum/swingup", {".*": noisy}, noise_seed=seed, task_kwargs={"random": 0}
        )
        runs.append([])
        for _ in range(2):
            env.reset()
            env.step(np.array([0.3]))
            runs[-1].append(env.signals()["current"])
    assert runs[0] == runs[1]
    assert len({*runs[0], *runs[2]}) == 4


MAXON = {".*": "maxon-ec45-flat-50w"}


def test_current_commands_are_in_amperes():
    motor = Drive.from_motor_parameters(motor_entry("maxon-ec45-flat-50w").parameters).replaced(
        {"controller.max_current": 5.0}
    )
    env = codrl_mj.make_dm_control(
        "cheetah/run", {".*": motor}, action="current", task_kwargs={"random": 0}
    )
    spec = env.action_spec()
    np.testing.assert_array_equal((spec.minimum, spec.maximum), ([-5.0] * 6, [5.0] * 6))
    env.reset()
    action = np.array([0.3, -0.2, 0.1, 5.0, 9.0, 0.0])
    env.step(action)
    np.testing.assert_allclose(
        env.signals()["reference_current"], np.clip(action, -5.0, 5.0), rtol=1e-12
    )
    with pytest.raises(ValueError, match=r"action has shape \(1,\): must be \(6,\)"):
        env.step(np.zeros(1))
    with pytest.raises(AttributeError, match="nothing"):
        _ = env.nothing


def test_randomization_does_not_change_the_distribution_of_initial_states():
    draws = {
        ".*": {"motor.resistance": "uniform(0.6, 1.2)"},
        "model.mass.torso": "uniform(0.5, 2.0)",
    }
    arguments = {"task_kwargs": {"random": 3}}
    env = codrl_mj.make_dm_control("cheetah/run", MAXON, randomize=draws, noise_seed=1, **arguments)
    same_env = codrl_mj.make_dm_control(
        "cheetah/run", MAXON, randomize=draws, noise_seed=1, **arguments
    )
    original = codrl_mj.make_dm_control("cheetah/run", MAXON, **arguments)
    mass, factors = original.mujoco[0].body("torso").mass[0], []
    for _ in range(3):
        (timestep, same_timestep), original_timestep = (
            (each_env.reset() for each_env in (env, same_env)),
            original.reset(),
        )
        np.testing.assert_array_equal(
            timestep.observation["position"], same_timestep.observation["position"]
        )
        assert env.randomization == same_env.randomization
        factors.append(env.randomization["model.mass.torso"])
        assert env.mujoco[0].body("torso").mass[0] == mass * factors[-1]
        resistance = env.randomization[".*"]["motor.resistance"]
        assert {motor.motor.resistance for motor in env.motors.values()} == {resistance}
        assert (
            timestep.observation["position"].shape
            == original_timestep.observation["position"].shape
        )
    assert len(set(factors)) == 3
    with pytest.raises(
        ValueError, match="randomize: Environment builds its model again at every reset"
    ):
        codrl_mj.make_dm_control(
            REBUILT["reach"], IDEAL, randomize={"model.gravity": "uniform(0.9, 1.1)"}
        )


def test_commands_are_delayed_by_whole_environment_steps():
    env = codrl_mj.make_dm_control("cheetah/run", IDEAL, disturbances={"command_delay": 0.02})
    inputs = _inputs(env, 10)
    # A reset must delete delayed commands.
    for _ in range(2):
        env.reset()
        for index, action in enumerate(inputs):
            env.step(action)
            # The delay is two steps of 0.01 s.
            expected = inputs[index - 2] if index >= 2 else np.zeros(6)
            np.testing.assert_allclose(env.signals()["desired_force"], expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("environment", "actuators", "message"),
    [
        ("cheetah/rn", IDEAL, r"environment = 'cheetah/rn': did you mean 'cheetah/run'\?"),
        ("cheetah/run", {"knee": "lag"}, r"'knee': no actuator has such a name.*bthigh"),
        (None, IDEAL, "environment = None: must be DOMAIN/TASK, or a function .*; pass a function"),
        (lambda: None, IDEAL, "environment: the function made None, must make a dm_env.Environ"),
        (lambda: gym.make("Reacher-v5"), IDEAL, "or use codrl_mj.make for an environment of Gymn"),
    ],
)
def test_raises_for_wrong_arguments(environment, actuators, message):
    with pytest.raises(ValueError, match=message):
        codrl_mj.make_dm_control(environment, actuators)
