"""Robots of other people's in environments: motors that do nothing, and others' beside ours."""

import functools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv

import codrl_mj
from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor
from tests.add_motors.models import MENAGERIE
from tests.external_envs.models import actions, assert_same, run
from tests.matrix import matrix_params

pytestmark = pytest.mark.filterwarnings(
    "ignore::UserWarning"
)  # deprecated attributes in other people's models
IDEAL = {".*": "ideal"}


class Robot(MujocoEnv):
    """Any model as an environment: its own controls, its state, an end after a second."""

    def __init__(self, path, **options):
        """Build the model from the file."""
        super().__init__(str(path), 5, None, **options)
        size = self.data.qpos.size + self.data.qvel.size
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float64)

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        return self.state_vector(), 0.0, False, self.data.time > 1.0, {}

    def reset_model(self):
        self.set_state(self.init_qpos, self.np_random.uniform(-0.1, 0.1, self.model.nv))
        return self.state_vector()


@pytest.fixture
def robot():
    """Registers a model's file, and returns the id."""

    def registered(path):
        gym.register("ForeignRobot-v0", functools.partial(Robot, path))
        return "ForeignRobot-v0"

    yield registered
    gym.registry.pop("ForeignRobot-v0", None)


@pytest.mark.parametrize(
    "path", matrix_params(MENAGERIE[5:6], MENAGERIE), ids=lambda path: path.parent.name
)
def test_ideal_motors_change_no_bit_of_robots_that_one_can_buy(path, robot):
    env_id = robot(path)
    plain, ours = gym.make(env_id), codrl_mj.make(env_id, IDEAL)
    assert len(ours.motors) == plain.unwrapped.model.nactuator > 0
    inputs = actions(plain, 250)
    assert_same(run(ours, inputs, seed=3), run(plain, inputs, seed=3))


BESIDE = """
<mujoco>
  <extension>
    <plugin plugin="mujoco.pid"><instance name="pid"><config key="kp" value="9"/></instance></plugin>
  </extension>
  <worldbody>
    <body><joint name="a" axis="0 1 0"/><geom type="capsule" size=".05 .2" mass="1"/>
      <body pos="0 0 .5"><joint name="b" axis="0 1 0" range="-90 90"/><geom size=".1" mass=".7"/>
        <body pos="0 0 .3"><joint name="c" axis="0 1 0"/><geom size=".1" mass=".3"/></body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="ours" joint="a" ctrlrange="-1 1"/>
    <muscle name="muscle" joint="b" ctrlrange="0 1"/>
    <plugin name="pid" joint="c" plugin="mujoco.pid" instance="pid" actdim="0" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


def test_motors_of_ours_stand_beside_a_muscle_and_a_plugin_of_others(robot, tmp_path):
    path = tmp_path / "beside.xml"
    path.write_text(BESIDE)
    env_id = robot(path)
    plain, ours = gym.make(env_id), codrl_mj.make(env_id, {"ours": "ideal"})
    inputs = actions(plain, 200)
    assert_same(run(ours, inputs, seed=0), run(plain, inputs, seed=0))
    assert list(ours.motors) == [0]
    with pytest.raises(ValueError, match=r"muscle of b: cannot have a motor: .*mjDYN_MUSCLE"):
        codrl_mj.make(env_id, {"muscle": "ideal"})


STIFF = DCMotorActuator(Motor(inductance=1e-3), CurrentLoop(kp=1.0))
NONE = "<mujoco><worldbody><body><joint name='a'/><geom size='1'/></body></worldbody></mujoco>"


@pytest.mark.parametrize(
    ("env_id", "actuators", "message"),
    [
        ("ForeignRobot-v0", IDEAL, "the model has no actuators"),
        ("HalfChetah-v5", IDEAL, "Did you mean: `HalfCheetah`"),
        (
            "HalfCheetah-v5",
            {".*": STIFF},
            r"'\.\*': actuator: .* unstable at a step of 0.01 s.*allow_unstable",
        ),
    ],
)
def test_what_is_wrong_is_said(robot, tmp_path, env_id, actuators, message):
    (tmp_path / "none.xml").write_text(NONE)
    robot(tmp_path / "none.xml")
    with pytest.raises((ValueError, gym.error.NameNotFound), match=message):
        codrl_mj.make(env_id, actuators)
