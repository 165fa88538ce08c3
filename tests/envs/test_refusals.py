"""Bad input is refused with a `ValueError` that names field, value and bound."""

import re

import gymnasium
import numpy as np
import pytest

from codrl_mj.actuators import Actuator, CurrentLoop, Motor
from codrl_mj.envs import ActuatedEnv
from codrl_mj.physics import PHYSICS, SimulationDivergedError
from codrl_mj.tasks import TASKS

UNSTABLE = Actuator(Motor(arm_radius=0.15), CurrentLoop(kp=100.0, max_voltage=float("inf")))

BAD = {
    "task": ({"task": "cartpol"}, "unknown task 'cartpol': did you mean 'cartpole'"),
    "task like none": ({"task": "xyz"}, "unknown task 'xyz': Known: "),
    "actuator": ({"actuator": "papr"}, "unknown actuator 'papr': did you mean 'paper'"),
    "actuator type": ({"actuator": 3.0}, r"actuator = 3.0: must be a name"),
    "actuator field": ({"actuator": {"motor": {"resistanze": 1}}}, "motor.resistanze; did you mean motor.resistance?"),
    "actuator value": (
        {"actuator": {"motor": {"resistance": -1.0}}},
        "Motor.resistance = -1.0: must be a finite number > 0",
    ),
    "physics": ({"physics": "bullet"}, "unknown physics 'bullet': Known: mujoco, analytic"),
    "integrator": ({"integrator": "rk45"}, "integrator = 'rk45': cartpole has euler, semi-implicit"),
    "inner_steps": ({"inner_steps": 0}, "inner_steps = 0: must be an integer >= 1"),
    "timestep": ({"timestep": -0.01}, "timestep = -0.01: must be a finite number > 0"),
    "timestep text": ({"timestep": "1e-3"}, "timestep = '1e-3': must be a finite number > 0"),
    "timestep ratio": ({"timestep": 0.015}, "timestep = 0.015 s does not divide cartpole's environment step of 0.02 s"),
    "both": ({"inner_steps": 2, "timestep": 0.01}, "inner_steps = 2 and timestep = 0.01: give one of them, not both"),
    "option": ({"centre_radius": 0.1}, "unknown option 'centre_radius' of cartpole: it has center_radius"),
    "option value": ({"center_radius": -0.1}, "center_radius = -0.1: must be a number > 0"),
    "option NaN": ({"center_radius": float("nan")}, "center_radius = nan: must be a number > 0"),
    "option type": ({"center_radius": "0.1"}, "center_radius = '0.1': must be a number > 0"),
    "option bool": ({"center_radius": True}, "center_radius = True: must be a number > 0"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_argument_is_refused(case):
    arguments, message = BAD[case]
    with pytest.raises(ValueError, match=re.escape(message)):
        ActuatedEnv(**{"task": "cartpole", **arguments})


def test_an_unknown_render_mode_is_refused_when_it_is_rendered():
    """Gymnasium warns of it when the environment is made, and its test suite wants no more."""
    env = ActuatedEnv("cartpole", render_mode="rgb_aray")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=re.escape("render_mode = 'rgb_aray': must be None, 'human' or 'rgb_array'")):
        env.render()


@pytest.mark.parametrize(
    ("view", "message"),
    [
        ({"camera": "fixd"}, "camera = 'fixd': did you mean 'fixed'? The model's cameras are fixed, close"),
        ({"width": 0}, "width = 0: must be an integer from 1 to 3840 [px]"),
        ({"width": 3841}, "width = 3841: must be an integer from 1 to 3840 [px]"),
        ({"height": 2161}, "height = 2161: must be an integer from 1 to 2160 [px]"),
        ({"height": 100.5}, "height = 100.5: must be an integer from 1 to 2160 [px]"),
        ({"height": True}, "height = True: must be an integer from 1 to 2160 [px]"),
    ],
)
@pytest.mark.parametrize("physics", PHYSICS)
def test_a_bad_view_is_refused(view, message, physics):
    def look():
        env = ActuatedEnv("cartpole", physics=physics, render_mode="rgb_array", **view)
        env.reset(seed=0)
        env.render()

    with pytest.raises(ValueError, match=re.escape(message)):
        look()


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    "action", [np.nan, None, "left", 7, -1, 1.5, [0, 1], np.array([np.nan], np.float32), {}], ids=repr
)
def test_a_bad_action_is_refused_and_changes_nothing(task, action):
    env = gymnasium.make(TASKS[task].env_id, disable_env_checker=True).unwrapped
    env.reset(seed=0)
    before = env.state
    with pytest.raises(ValueError, match="action") as refused:
        env.step(action)
    assert repr(action) in str(refused.value)
    np.testing.assert_array_equal(env.state, before)
    assert env.data.time == 0.0


def test_an_unstable_loop_is_refused_with_its_radius_and_allowed_on_request(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the engine writes a log
    # |1 - (1 + 100)*0.02/0.1| = 19.2
    with pytest.raises(ValueError, match=r"unstable at a step of 0\.02 s: spectral radius 19\.2, must be < 1"):
        ActuatedEnv("cartpole", actuator=UNSTABLE)
    for physics in PHYSICS:
        env = ActuatedEnv("cartpole", actuator=UNSTABLE, physics=physics, allow_unstable=True)
        env.reset(seed=0)

        def run(env=env):
            for _ in range(500):
                env.step(1)

        with (
            np.errstate(all="ignore"),
            pytest.raises(SimulationDivergedError, match="cartpole: the simulation diverged"),
        ):
            run()
        env.reset(seed=0)
        assert np.isfinite(env.step(1)[0]).all()


def test_an_unstable_loop_is_stable_with_the_substeps_that_the_refusal_proposes():
    with pytest.raises(ValueError, match=r"controller\.substeps = \d+") as refused:
        ActuatedEnv("cartpole", actuator=UNSTABLE)
    substeps = int(re.search(r"controller\.substeps = (\d+)", str(refused.value)).group(1))
    mapping = UNSTABLE.as_mapping()
    mapping["controller"]["substeps"] = substeps
    env = ActuatedEnv("cartpole", actuator=mapping)
    env.reset(seed=0)
    for _ in range(20):
        _, _, _, _, info = env.step(1)
    # no integral: the current is kp/(R + kp) of its reference
    assert info["current"] == pytest.approx(info["reference_current"] * 100 / 101, rel=1e-3)


def test_a_shorter_step_makes_a_loop_stable_too():
    # a proportional loop is stable up to dt = 2L/(R + kp) = 0.00198 s
    for inner_steps, fine in ((10, False), (11, True)):
        if fine:
            ActuatedEnv("cartpole", actuator=UNSTABLE, inner_steps=inner_steps)
        else:
            with pytest.raises(ValueError, match="unstable"):
                ActuatedEnv("cartpole", actuator=UNSTABLE, inner_steps=inner_steps)


def test_a_mapping_is_as_good_as_an_actuator():
    mapping = {"motor": {"arm_radius": 0.15}, "controller": {"kp": 2.0}}
    one, two = (
        ActuatedEnv("cartpole", actuator=mapping),
        ActuatedEnv("cartpole", actuator=Actuator.from_mapping(mapping)),
    )
    assert one.actuator == two.actuator
