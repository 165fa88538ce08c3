"""Options of Furuta: a rig of other masses, lengths, inertias and damping on every interface."""

import mujoco
import numpy as np
import pytest
import tyro

import codrl_mj
from codrl_mj import suite
from codrl_mj.cli.environments import build_env_config
from codrl_mj.cli.train import train_verb
from codrl_mj.envs.config import EnvConfig
from codrl_mj.physics.variation import bare_model
from codrl_mj.tasks import TASKS
from codrl_mj.tasks.furuta import HUB_INERTIA, Options, ReferenceEnv
from codrl_mj.user_code import asset_path
from codrl_mj.validation.dynamics import TOLERANCE, accelerations_with_options
from codrl_mj.viz.scene import scene_of
from tests.tasks.test_furuta import NUMBERS, accelerations, max_error, states

TASK = TASKS["furuta"]
RIG = {"rod_length": 0.2, "arm_length": 0.11, "rod_mass": 0.04, "arm_mass": 0.15}
DAMPED = {"arm_damping": 3e-4, "rod_damping": 2e-5}
LAGRANGE_NAMES = {"arm_damping": "c", "rod_damping": "d"}


def play(env, steps=60):
    """Return the observations of an episode under a slow sine of the action."""
    observations = [env.reset(seed=1)[0]]
    for step in range(steps):
        action = 0.1 * env.action_space.high * np.sin(0.2 * step)
        observations.append(env.step(action.astype(np.float32))[0])
    return np.array(observations)


@pytest.mark.parametrize("options", [RIG, RIG | DAMPED, {"rod_length": 0.06, "rod_mass": 0.01}])
def test_accelerations_of_another_rig_equal_lagranges(options):
    env = codrl_mj.make("furuta", actuator="ideal", **options).unwrapped
    changed = {LAGRANGE_NAMES.get(name, name): value for name, value in options.items()}
    for state in states(100, seed=5):
        env.data.qpos[:], env.data.qvel[:] = state[:2], state[2:]
        env.data.qfrc_applied[0] = 0.03
        mujoco.mj_forward(env.model, env.data)
        expected = accelerations(state, 0.03, **changed)
        assert max_error(env.data.qacc, expected) < 1e-11
        closed_form = ReferenceEnv(Options(**options)).derivative(state, 0.03)[2:]
        assert max_error(closed_form, expected) < 1e-11


def test_the_certificate_compares_several_rigs_with_the_closed_form():
    (result,) = accelerations_with_options(TASK, TASK.reference_states, 3)
    assert result.samples == 5 * 405 == len(TASK.reference_options) * 405
    assert result.worst < TOLERANCE == 1e-12


def test_the_inertias_of_uniform_parts_are_those_of_the_default_rig():
    """Written out, they move the default rig in the same way, up to rounding."""
    arm = NUMBERS["arm_mass"] * NUMBERS["arm_length"] ** 2 / 3 + HUB_INERTIA
    rod = NUMBERS["rod_mass"] * NUMBERS["rod_length"] ** 2 / 3
    options = {"arm_inertia": arm, "rod_inertia": rod, "rod_center": NUMBERS["rod_length"] / 2}
    default, explicit = (
        codrl_mj.make("furuta", actuator="ideal", **chosen) for chosen in ({}, options)
    )
    np.testing.assert_allclose(play(explicit), play(default), atol=1e-6)
    # Twice the inertia about the shaft halves an acceleration that the rod does not influence.
    slow = codrl_mj.make("furuta", actuator="ideal", rod_mass=1e-6, arm_inertia=2.0 * arm)
    env = slow.unwrapped
    env.data.qfrc_applied[0] = 0.01
    mujoco.mj_forward(env.model, env.data)
    assert env.data.qacc[0] == pytest.approx(0.01 / (2.0 * arm), rel=1e-3)


def test_default_options_leave_the_model_as_its_file_has_it():
    model = bare_model("furuta")
    stored = mujoco.MjModel.from_xml_path(str(asset_path(TASK.asset)))
    for name in ("body_mass", "body_inertia", "body_ipos", "body_pos", "dof_damping"):
        np.testing.assert_array_equal(getattr(model, name), getattr(stored, name))
    explicit = EnvConfig("furuta", options=Options()._asdict())
    assert explicit.as_mapping() == EnvConfig("furuta").as_mapping()
    assert EnvConfig("furuta").as_mapping()["options"] == {}


@pytest.mark.matrix
def test_every_interface_has_the_rig():
    """Single and batched, MuJoCo and closed form, Stable-Baselines3, dm_control, and scenes."""
    env = codrl_mj.make("furuta", **RIG)
    expected = play(env)
    batch = codrl_mj.make_vec("furuta", 3, **RIG)
    np.testing.assert_array_equal(batch.reset(seed=1)[0][0], expected[0])
    for step, observation in enumerate(expected[1:]):
        action = 0.1 * env.action_space.high * np.sin(0.2 * step)
        actions = np.tile(action.astype(np.float32), (3, 1))
        np.testing.assert_array_equal(batch.step(actions)[0][0], observation)
    ideal, closed = (
        play(codrl_mj.make("furuta", actuator="ideal", physics=physics, **RIG))
        for physics in ("mujoco", "analytic")
    )
    np.testing.assert_allclose(ideal, closed, rtol=1e-6, atol=1e-6)
    sb3 = codrl_mj.make_sb3_vec_env("furuta", 2, **RIG)
    assert sb3.get_attr("arm_mass") == [RIG["arm_mass"]] * 2
    assert suite.load("furuta", "gym", **RIG).model.body_mass[1:].tolist() == [0.15, 0.04]
    scene = scene_of(EnvConfig("furuta", options=RIG))
    np.testing.assert_array_equal(
        scene.model.geom("rod").size, env.unwrapped.model.geom("rod").size
    )
    drawn = codrl_mj.make("furuta", randomize={"model.length.rod": "choice(1.5)"}, **RIG)
    drawn.reset(seed=0)
    assert drawn.unwrapped.rod_length == pytest.approx(0.3)


def test_attributes_have_the_options():
    env = codrl_mj.make("furuta", actuator="ideal", **RIG, arm_inertia=3e-4).unwrapped
    assert {name: getattr(env, name) for name in RIG} == pytest.approx(RIG)
    env.arm_length = 0.22
    assert env.model.body("rod").pos[2] == pytest.approx(0.22)


def test_flags_and_files_have_the_options():
    words = ["furuta", "--env.rod-length", "0.2", "--env.arm-damping", "0"]
    verb = tyro.cli(train_verb(words), args=words)
    config = build_env_config(verb, "furuta", verb.actuator_name, EnvConfig("furuta"))
    assert config.as_mapping()["options"] == {"rod_length": 0.2, "arm_damping": 0.0}
    assert EnvConfig.from_mapping(config.as_mapping()) == config


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rod_length": 0.0}, r"rod_length = 0.0: must be a finite number > 0 \[m\]"),
        ({"arm_mass": float("inf")}, r"arm_mass = inf: must be a finite number > 0 \[kg\]"),
        ({"rod_damping": -1.0}, r"rod_damping = -1.0: must be a finite number >= 0 \[N\*m\*s/rad"),
        ({"rod_mass": True}, "rod_mass = True: must be a finite number > 0"),
        ({"rod_lenght": 0.2}, "did you mean 'rod_length'"),
        ({"rod_inertia": 1e-5}, r"it must be at least 9\.998e-05 kg\*m\^2; correct rod_inertia"),
    ],
)
def test_impossible_rigs_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        codrl_mj.make("furuta", **options)
