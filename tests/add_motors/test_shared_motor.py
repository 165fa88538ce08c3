"""One motor behind several actuators of a joint, such as `<position>` and `<velocity>`."""

import copy

import gymnasium
import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Lag, Servo, TorqueSpeed
from codrl_mj.engine import motors
from codrl_mj.engine.joint_dynamics import MotorWarning
from codrl_mj.sizing.choice import actuators_of
from codrl_mj.validation import validate_model
from tests.add_motors.models import INTEGRATORS

_LEG = """
<mujoco>
  <compiler autolimits="false"/>
  <option timestep="0.002" integrator="{}"/>
  <worldbody>
    <body><joint name="hip" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="2"/>
      <body pos="0 0 -.3"><joint name="knee" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/></body></body>
  </worldbody>
  <actuator>{}</actuator>
</mujoco>
"""
KP, KV = 50.0, 2.0
PAIR = (
    '<position name="hip_p" joint="hip" kp="50" {}/><velocity name="hip_v" joint="hip" kv="2" {}/>'
)
SUM = '<general name="hip" joint="hip" gainprm="1" biastype="affine" biasprm="0 -50 -2"/>'
KNEE = '<motor name="knee" joint="knee"/>'
MAXON = {"name": "maxon-ec45-flat-50w", "motor": {"gear_ratio": 100.0}}
MOTORS = {
    "drive": MAXON,
    "lag": Lag(time_constant=0.01),
    "torque_speed": TorqueSpeed(8.0, 5.0, 6.0),
    "ideal": "ideal",
}
TOGETHER = ("hip_p", "hip_v")


def _leg(actuators, integrator="Euler"):
    return mujoco.MjSpec.from_string(_LEG.format(integrator, actuators))


def _pair(first="", second="", integrator="Euler", also=""):
    return _leg(PAIR.format(first, second) + also, integrator)


def _targets(steps=400):
    generator = np.random.default_rng(3)
    return np.repeat(generator.uniform((-1.0, -3.0), (1.0, 3.0), (steps // 25, 2)), 25, axis=0)


def _run(model, controls, data=None):
    data = mujoco.MjData(model) if data is None else data
    rows = []
    for control in controls:
        data.ctrl[: len(control)] = control
        mujoco.mj_step(model, data)
        rows.append((*data.qpos, *data.qvel, *data.qfrc_actuator))
    return np.array(rows)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", MOTORS)
def test_a_shared_motor_delivers_the_sum_of_both_forces(name, integrator):
    """Compare with a single actuator whose control and bias are the sums of the two."""
    targets = _targets()
    both = codrl_mj.add_motors(_pair(integrator=integrator), {TOGETHER: MOTORS[name]}).compile()
    single = codrl_mj.add_motors(_leg(SUM, integrator), {"hip": MOTORS[name]}).compile()
    assert (both.nu, single.nu) == (2, 1)
    np.testing.assert_array_equal(both.dof_M0, single.dof_M0)
    np.testing.assert_array_equal(both.dof_frictionloss, single.dof_frictionloss)
    summed = (targets @ (KP, KV))[:, np.newaxis]
    np.testing.assert_allclose(_run(both, targets), _run(single, summed), rtol=0, atol=1e-11)


def test_the_desired_force_equals_the_closed_form():
    model = codrl_mj.add_motors(_pair(), {"hip_p & hip_v": Lag(time_constant=0.01)}).compile()
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0], data.ctrl[:] = 0.2, -0.7, (0.5, 1.5)
    mujoco.mj_forward(model, data)
    expected = KP * (0.5 - 0.2) + KV * (1.5 + 0.7)
    assert codrl_mj.signals(model, data)["desired_force"] == pytest.approx([expected], abs=1e-12)
    assert list(motors(model)) == [0]


def test_an_ideal_shared_motor_equals_the_plain_pair():
    targets = _targets()
    ours = codrl_mj.add_motors(_pair(), {TOGETHER: "ideal"}).compile()
    np.testing.assert_allclose(
        _run(ours, targets), _run(_pair().compile(), targets), rtol=0, atol=1e-11
    )


def test_each_joint_gets_one_shared_motor():
    spec = _pair(
        also=(
            '<position name="knee_p" joint="knee" kp="9"/><velocity name="knee_v" joint="knee"'
            ' kv="1"/>'
        )
    )
    model = codrl_mj.add_motors(spec, {".*_p & .*_v": "lag"}).compile()
    assert motors(model) == {0: Lag(), 2: Lag()}
    assert model.nu == 4


def test_saved_copied_and_attached_models_keep_a_shared_motor():
    targets, lag = _targets(), {"hip_p & hip_v": Lag(time_constant=0.01)}
    spec = codrl_mj.add_motors(_pair(), lag)
    expected = _run(spec.compile(), targets)
    for model in (
        mujoco.MjModel.from_xml_string(spec.to_xml()),
        copy.deepcopy(spec.compile()),
        spec.copy().compile(),
    ):
        np.testing.assert_array_equal(_run(model, targets), expected)
    scene = mujoco.MjSpec()
    scene.option.timestep = 0.002
    scene.attach(spec.copy(), prefix="a/", frame=scene.worldbody.add_frame())
    np.testing.assert_allclose(_run(scene.compile(), targets), expected, rtol=0, atol=1e-11)
    model = spec.compile()
    halfway = mujoco.MjData(model)
    _run(model, targets[:200], halfway)
    np.testing.assert_array_equal(_run(model, targets[200:], copy.copy(halfway)), expected[200:])


def test_the_certificate_passes_a_shared_motor_without_omissions():
    certificate = validate_model(
        codrl_mj.add_motors(_pair(), {TOGETHER: "lag"}).compile(), quick=True
    )
    assert certificate.passed
    assert not [check for check in certificate.skipped if "not motors" in check.reason]


def test_an_actuators_forcerange_is_kept_and_does_not_limit_the_motor():
    """The force of each actuator is clipped as in MuJoCo before the sum becomes the command."""
    limited = 'forcelimited="true" forcerange="-3 3"'
    model = codrl_mj.add_motors(_pair(limited), {TOGETHER: "ideal"}).compile()
    data = mujoco.MjData(model)
    data.ctrl[:] = 1.0, 5.0
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[0] == pytest.approx(3.0 + KV * 5.0, abs=1e-12)


REFUSED = [
    ((), TOGETHER, Servo(), "the command of a Servo is one motion"),
    (('gear="2"', ""), TOGETHER, "lag", "whose gear differs"),
    (('group="2"', ""), TOGETHER, "lag", "whose group differs"),
    (
        ('forcelimited="true" forcerange="-3 3"',) * 2,
        TOGETHER,
        "lag",
        "limit the joint instead, with actuatorfrcrange",
    ),
    ((), ("hip_p", "knee"), "lag", "'hip_p & knee' matches actuator hip_p of hip alone"),
    ((), ("hip_p", "hip_w"), "lag", "'hip_w': no actuator has such a name"),
    ((), ".*", "lag", r"For one motor behind all of them write 'hip_p & hip_v'"),
]


@pytest.mark.parametrize(("attributes", "pattern", "actuator", "message"), REFUSED)
def test_actuators_that_cannot_share_a_motor_raise(attributes, pattern, actuator, message):
    spec = _pair(*attributes, also=KNEE)
    with pytest.raises(ValueError, match=message):
        codrl_mj.add_motors(spec, {pattern: actuator})


def test_an_actuator_past_a_motor_causes_a_warning():
    with pytest.warns(
        MotorWarning,
        match="actuator hip_v drives the joint of hip_p without its motor: 'hip_p & hip_v'",
    ):
        codrl_mj.add_motors(_pair(), {"hip_p": "lag"})


def test_a_tasks_motors_are_separate():
    with pytest.raises(ValueError, match="pendulum has a motor at each of its joints"):
        codrl_mj.EnvConfig("pendulum", {"motor & motor": "lag"})


class Leg(gymnasium.Env):
    """Environment of the pair and a motor at the knee."""

    metadata = {"render_modes": []}  # noqa: RUF012
    render_mode = None

    def __init__(self, knee=KNEE):
        """Build the model."""
        self.model = mujoco.MjModel.from_xml_string(
            _LEG.format("Euler", PAIR.format("", "") + knee)
        )
        self.data, self.dt = mujoco.MjData(self.model), 0.02
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,))

    def reset(self, *, seed=None, options=None):  # noqa: ARG002
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        return self.data.qpos.copy(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 10)
        return self.data.qpos.copy(), 0.0, False, False, {}


ACTUATORS = {"hip_p & hip_v": Lag(time_constant=0.01), "knee": "lag"}


def _make(**options):
    return codrl_mj.make(Leg, ACTUATORS, disable_env_checker=True, max_episode_steps=100, **options)


def test_an_environment_has_one_motor_for_the_pair():
    env = _make(randomize={"hip_p & hip_v:time_constant": "uniform(0.02, 0.03)"})
    _, info = env.reset(seed=1)
    assert env.recorder.motor_names == ("hip_p & hip_v", "knee")
    assert env.action_space.shape == (3,)
    assert 0.02 <= env.motors[0].time_constant <= 0.03
    assert info["randomization"]
    info = env.step(np.array([0.3, 0.1, 0.0], dtype=np.float32))[-1]
    assert info["desired_force"].shape == (2,)


def test_evaluation_variants_keep_a_shared_motor(monkeypatch):
    monkeypatch.setitem(
        gymnasium.registry, "Leg-v0", gymnasium.envs.registration.EnvSpec("Leg-v0", Leg)
    )
    config = codrl_mj.EnvConfig("Leg-v0", ACTUATORS, max_episode_steps=10)
    lag = Lag(time_constant=0.01)
    assert config.source.override_actuators(config, {"knee": "ideal"}) == {
        "hip_p & hip_v": lag,
        "knee": "ideal",
    }
    assert codrl_mj.EnvConfig.from_mapping(config.as_mapping()) == config


def test_both_commands_are_delayed_and_loads_act_once():
    env = _make(disturbances={"command_delay": 0.02})
    env.reset(seed=1)
    env.step(np.array([0.5, 0.25, 0.75], dtype=np.float32))
    assert list(env.unwrapped.data.ctrl) == [0.0, 0.0, 0.0]
    env.step(np.zeros(3, dtype=np.float32))
    assert list(env.unwrapped.data.ctrl) == [0.5, 0.25, 0.75]
    env = _make(disturbances={"pulse_force": 2.0, "pulse_duration": 0.1, "pulse_interval": 0.02})
    env.reset(seed=1)
    loads = []
    for _ in range(60):
        env.step(np.zeros(3, dtype=np.float32))
        loads.append(env.unwrapped.data.qfrc_applied.copy())
    assert np.abs(loads).max(axis=0) == pytest.approx([2.0, 2.0])


def test_a_shared_motor_refuses_current_commands():
    with pytest.raises(ValueError, match="hip_p: is not a plain motor"):
        codrl_mj.make(Leg, {"hip_p & hip_v": MAXON}, action="current", disable_env_checker=True)


@pytest.mark.parametrize(("limit", "fits"), [(1.0, False), (1000.0, True)])
def test_a_forcerange_that_would_limit_a_voltage_raises(limit, fits):
    """24 V stand for the stall torque 24/R*kT*100; with the range, 1.4 V of 24 V would arrive."""
    knee = f'<motor name="knee" joint="knee" forcelimited="true" forcerange="-{limit} {limit}"/>'
    options = {"action": "voltage", "knee": knee, "disable_env_checker": True}
    if fits:
        env = codrl_mj.make(Leg, {"knee": MAXON}, **options)
        env.reset(seed=0)
        assert env.step(np.array([0, 0, 24.0], dtype=np.float32))[-1]["voltage"] == pytest.approx(
            24.0
        )
    else:
        with pytest.raises(
            ValueError, match=f"knee: forcerange = {limit:g}: would cut commands of up to 24 V"
        ):
            codrl_mj.make(Leg, {"knee": MAXON}, **options)


def test_a_chosen_motor_is_for_both_actuators():
    """`codrl-mj motor choose` writes a file of patterns that are motors' names."""

    class Choice:
        name = "any"

        def for_model_gear(self, gear):  # noqa: ARG002
            return Lag()

    class Demand:
        model_gear = 1.0

    assert list(
        actuators_of({"hip_p & hip_v": (Choice(), Demand()), "a.b": (Choice(), Demand())})
    ) == [
        "hip_p & hip_v",
        r"a\.b",
    ]
