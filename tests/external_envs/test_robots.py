"""Third-party robots as environments: ideal motors, and motors beside other actuators."""

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

# Third-party models have deprecated attributes.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
IDEAL = {".*": "ideal"}


class Robot(MujocoEnv):
    """Environment for any model: its own controls and state, and episodes of one second."""

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
    """Return a function that registers a model's file and returns the id."""

    def register(path):
        gym.register("ForeignRobot-v0", functools.partial(Robot, path))
        return "ForeignRobot-v0"

    yield register
    gym.registry.pop("ForeignRobot-v0", None)


@pytest.mark.parametrize(
    "path", matrix_params(MENAGERIE[5:6], MENAGERIE), ids=lambda path: path.parent.name
)
def test_ideal_motors_do_not_change_robots_of_the_menagerie(path, robot):
    env_id = robot(path)
    original, ours = gym.make(env_id), codrl_mj.make(env_id, IDEAL)
    assert len(ours.motors) == original.unwrapped.model.nactuator > 0
    inputs = actions(original, 250)
    assert_same(run(ours, inputs, seed=3), run(original, inputs, seed=3))


BESIDE = """
<mujoco>
  <extension>
    <plugin plugin="mujoco.pid">
      <instance name="pid"><config key="kp" value="9"/></instance>
    </plugin>
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


def test_motors_work_beside_a_muscle_and_another_plugin(robot, tmp_path):
    path = tmp_path / "beside.xml"
    path.write_text(BESIDE)
    env_id = robot(path)
    original, ours = gym.make(env_id), codrl_mj.make(env_id, {"ours": "ideal"})
    inputs = actions(original, 200)
    assert_same(run(ours, inputs, seed=0), run(original, inputs, seed=0))
    assert list(ours.motors) == [0]
    with pytest.raises(ValueError, match=r"muscle of b: cannot have a motor: .*mjDYN_MUSCLE"):
        codrl_mj.make(env_id, {"muscle": "ideal"})


STIFF = DCMotorActuator(Motor(inductance=1e-3), CurrentLoop(kp=1.0))
NO_ACTUATORS = (
    "<mujoco><worldbody><body><joint name='a'/><geom size='1'/></body></worldbody></mujoco>"
)


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
def test_raises_for_wrong_arguments(robot, tmp_path, env_id, actuators, message):
    (tmp_path / "none.xml").write_text(NO_ACTUATORS)
    robot(tmp_path / "none.xml")
    with pytest.raises((ValueError, gym.error.NameNotFound), match=message):
        codrl_mj.make(env_id, actuators)
