"""The control callback: the current loop of the reference, and a pure function of model and data."""

import copy

import mujoco
import numpy as np
import pytest

from codrl_mj import engine
from codrl_mj.actuators import Actuator, CurrentLoop, Motor
from codrl_mj.own_code import asset_path
from codrl_mj.tasks import TASKS
from tests.engine.models import (
    CURRENT,
    FULL,
    STATE,
    TICK,
    VOLTAGE,
    cartpole,
    changed,
    controls,
    full_state,
    rotor,
    rotor_spec,
    trajectory,
)
from tests.reference import MotorSimulation

pytestmark = pytest.mark.usefixtures("installed")

STEPS = 100
INPUTS = controls(STEPS, size=0.6)
INTEGRATORS = ("Euler", "implicitfast", "implicit", "RK4")


def _follow(model, data, actuator, inputs):
    """Step, and compare the motor with the reference fed with the simulated velocity; returns the currents."""
    reference, currents, timestep = MotorSimulation(actuator), [], model.opt.timestep
    arm = actuator.motor.arm_radius
    for (ctrl,) in inputs:
        data.ctrl[0] = ctrl
        force = reference.step(timestep, ctrl / arm, data.qvel[0])
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.act[STATE], reference.state, rtol=1e-11, atol=1e-12)
        assert data.act[VOLTAGE] == pytest.approx(reference.voltage, rel=1e-11, abs=1e-12)
        assert data.qfrc_actuator[0] == pytest.approx(force, rel=1e-11, abs=1e-12)
        currents.append(reference.current)
    return np.array(currents)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_the_motor_is_the_reference_in_every_integrator(integrator):
    model = rotor(FULL, integrator=integrator)
    data = mujoco.MjData(model)
    currents = _follow(model, data, FULL, INPUTS)
    assert np.abs(currents).max() > 0.3


# Each pair: the full actuator, and one with a single feature taken out.
REMOVED = {
    "back-EMF": {"back_emf_constant": 0.0},
    "compensation": {"bemf_compensation": False},
    "saturation": {"max_voltage": float("inf")},
    "feed-forward": {"kff": 0.0},
    "arm": {"arm_radius": 1.0},
    "substeps": {"substeps": 1},
    "integral": {"ki": 0.0},
    "derivative": {"kd": 0.0},
    "integral leak": {"integral_leak": 0.0},
    "derivative filter": {"derivative_time_constant": 0.0},
    "torque constant": {"torque_constant": 1.0},
    "resistance": {"resistance": 2.0},
    "inductance": {"inductance": 0.1},
    "proportional gain": {"kp": 1.0},
}


@pytest.mark.parametrize("feature", REMOVED)
def test_each_feature_acts_in_the_engine_and_as_the_reference_says(feature):
    """With the same controls both follow their reference, and they differ: neither ignores the feature."""
    runs = []
    for actuator in (changed(FULL, max_voltage=2.0), changed(FULL, **{"max_voltage": 2.0} | REMOVED[feature])):
        model = rotor(actuator)
        runs.append(_follow(model, mujoco.MjData(model), actuator, INPUTS))
    assert np.abs(runs[0] - runs[1]).max() > 1e-4


def test_a_motor_starts_at_rest_and_delivers_in_its_first_step():
    # deadbeat: kp + R = L/dt and kff = R reach the reference within one step, and that force moves this very step
    actuator = Actuator(Motor(inductance=0.05, back_emf_constant=0.0), CurrentLoop(kp=4.0, kff=1.0))
    model = rotor(actuator)
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.ctrl[0] = 0.5
    mujoco.mj_step(model, data)
    assert data.act[CURRENT] == pytest.approx(0.5, rel=1e-14)
    inertia = 0.05 + 0.5 * (0.1**2 + 0.2**2)
    assert data.qvel[0] == pytest.approx(0.01 * 0.5 / inertia, rel=1e-12)


# -- a pure function of model and data ----------------------------------------------------------------------


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_any_number_of_forward_calls_between_steps_changes_nothing(integrator):
    model = rotor(integrator=integrator)
    counts = np.random.default_rng(1).integers(0, 5, STEPS)

    def forward(data, index):
        for _ in range(counts[index]):
            mujoco.mj_forward(model, data)

    np.testing.assert_array_equal(trajectory(model, INPUTS), trajectory(model, INPUTS, before_step=forward))


def test_a_forward_call_under_another_control_leaves_no_trace():
    model = rotor()

    def try_another(data, index):
        wanted = data.ctrl.copy()
        data.ctrl[:] = -3.0
        mujoco.mj_forward(model, data)
        data.ctrl[:] = wanted

    np.testing.assert_array_equal(trajectory(model, INPUTS), trajectory(model, INPUTS, before_step=try_another))


def test_step1_and_step2_are_one_step():
    model = rotor()
    whole, data, split = trajectory(model, INPUTS), mujoco.MjData(model), []
    for ctrl in INPUTS:
        mujoco.mj_step1(model, data)
        data.ctrl[:] = ctrl  # the use of the split: the control may be chosen in between
        mujoco.mj_forward(model, data)
        mujoco.mj_step2(model, data)
        split.append(full_state(model, data))
    np.testing.assert_array_equal(whole, split)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_copy_of_the_data_continues_bit_for_bit(integrator):
    model = rotor(integrator=integrator)
    data = mujoco.MjData(model)
    trajectory(model, INPUTS[:40], data)
    twin = copy.copy(data)
    rest = trajectory(model, INPUTS[40:], data)
    np.testing.assert_array_equal(rest, trajectory(model, INPUTS[40:], twin))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_restored_state_vector_continues_bit_for_bit_in_fresh_data(integrator):
    model = rotor(integrator=integrator)
    data = mujoco.MjData(model)
    saved = trajectory(model, INPUTS[:40], data)[-1]
    rest = trajectory(model, INPUTS[40:], data)
    fresh = mujoco.MjData(model)
    mujoco.mj_setState(model, fresh, saved, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    np.testing.assert_array_equal(rest, trajectory(model, INPUTS[40:], fresh))


def test_going_back_to_an_earlier_state_repeats_what_followed():
    model = rotor()
    data = mujoco.MjData(model)
    saved = trajectory(model, INPUTS[:40], data)[-1]
    first = trajectory(model, INPUTS[40:], data)
    mujoco.mj_setState(model, data, saved, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    np.testing.assert_array_equal(first, trajectory(model, INPUTS[40:], data))


def test_a_keyframe_carries_the_motor():
    model = rotor()
    data = mujoco.MjData(model)
    trajectory(model, INPUTS[:40], data)
    rest = trajectory(model, INPUTS[40:], copy.copy(data))
    spec_with_key = rotor_spec()
    spec_with_key.add_key(time=data.time, qpos=data.qpos, qvel=data.qvel, act=data.act)
    keyed = spec_with_key.compile()
    fresh = mujoco.MjData(keyed)
    mujoco.mj_resetDataKeyframe(keyed, fresh, 0)
    np.testing.assert_array_equal(rest, trajectory(keyed, INPUTS[40:], fresh))


@pytest.mark.parametrize("shift", [-0.1234, -10.0, 5.0])
def test_setting_the_clock_back_or_forward_changes_neither_motor_nor_motion(shift):
    model = rotor()
    data = mujoco.MjData(model)
    trajectory(model, INPUTS[:40], data)
    twin = copy.copy(data)
    twin.time += shift
    rest = trajectory(model, INPUTS[40:], data)
    shifted = trajectory(model, INPUTS[40:], twin)
    np.testing.assert_array_equal(rest[:, 1:3], shifted[:, 1:3])  # position, velocity
    np.testing.assert_array_equal(rest[:, 4:], shifted[:, 4:])  # motor state but for its tick


def test_reset_puts_the_motor_at_rest():
    model = rotor()
    data = mujoco.MjData(model)
    first = trajectory(model, INPUTS, data)
    assert np.any(data.act != 0.0)
    mujoco.mj_resetData(model, data)
    np.testing.assert_array_equal(data.act, 0.0)
    np.testing.assert_array_equal(first, trajectory(model, INPUTS, data))


def test_the_tick_is_the_time_at_which_the_last_step_began():
    model = rotor()
    data = mujoco.MjData(model)
    trajectory(model, INPUTS[:7], data)
    assert data.act[TICK] == pytest.approx(0.06, abs=1e-15)
    mujoco.mj_forward(model, data)
    assert data.act[TICK] == data.time


def test_two_data_of_one_model_do_not_share_a_motor():
    model = rotor()
    alone = trajectory(model, INPUTS)
    data, other, states = mujoco.MjData(model), mujoco.MjData(model), []
    for ctrl in INPUTS:
        data.ctrl[:], other.ctrl[:] = ctrl, -2.0 * ctrl
        mujoco.mj_step(model, data)
        mujoco.mj_step(model, other)
        states.append(full_state(model, data))
    np.testing.assert_array_equal(alone, states)


# -- the control as the engine uses it ----------------------------------------------------------------------


def test_control_is_clamped_to_its_range():
    model, free = rotor(max_force=1.0), rotor()  # the arm is 0.5 m: the range is +-0.5 N*m
    inputs = controls(STEPS, size=2.0)
    assert np.abs(inputs).max() > 0.5
    np.testing.assert_array_equal(trajectory(model, inputs), trajectory(free, inputs.clip(-0.5, 0.5)))


def test_control_is_not_clamped_when_clamping_is_disabled():
    model, free = rotor(max_force=1.0), rotor()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    inputs = controls(STEPS, size=2.0)
    np.testing.assert_array_equal(trajectory(model, inputs), trajectory(free, inputs))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e11])
def test_a_control_that_is_not_a_number_counts_as_zero(bad, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the engine writes a log
    model = rotor()
    inputs = INPUTS.copy()
    inputs[50:60] = bad
    zeroed = np.where(inputs == INPUTS, inputs, 0.0)
    np.testing.assert_array_equal(trajectory(model, inputs), trajectory(model, zeroed))


def test_a_disabled_group_has_no_force_and_holds_the_motor():
    model = rotor()
    model.actuator_group[0] = 3
    data = mujoco.MjData(model)
    trajectory(model, INPUTS[:30], data)
    held = data.act.copy()
    model.opt.disableactuator = 1 << 3
    trajectory(model, INPUTS[30:40], data)
    np.testing.assert_array_equal(data.act, held)
    assert data.qfrc_actuator[0] == 0.0
    model.opt.disableactuator = 0
    # it continues from the state it held: the reference skips the ten steps
    reference = MotorSimulation(FULL)
    reference.state = tuple(held[STATE])
    for (ctrl,) in INPUTS[40:60]:
        data.ctrl[0] = ctrl
        reference.step(0.01, ctrl / FULL.motor.arm_radius, data.qvel[0])
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.act[STATE], reference.state, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("group", [0, 2, 5, 7, -1, 31])
def test_disabling_other_groups_leaves_a_motor_alone(group):
    model = rotor()
    expected = trajectory(model, INPUTS)
    model.actuator_group[0] = group
    model.opt.disableactuator = (1 << 6) - 1 - (1 << group if 0 <= group < 6 else 0)
    np.testing.assert_array_equal(trajectory(model, INPUTS), expected)


def test_a_disabled_group_of_zero_is_honoured():
    model = rotor()
    model.opt.disableactuator = 1
    data = mujoco.MjData(model)
    trajectory(model, INPUTS, data)
    np.testing.assert_array_equal(data.act, 0.0)


def test_disabled_actuation_holds_the_motor():
    model = rotor()
    data = mujoco.MjData(model)
    trajectory(model, INPUTS[:30], data)
    held = data.act.copy()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    trajectory(model, INPUTS[30:40], data)
    np.testing.assert_array_equal(data.act, held)
    assert data.qfrc_actuator[0] == 0.0


def test_parameters_are_read_from_the_model_at_every_step():
    model, weaker = rotor(), rotor(changed(FULL, kp=0.5))
    data, reference = mujoco.MjData(model), mujoco.MjData(weaker)
    model.actuator_user[0] = weaker.actuator_user[0]
    np.testing.assert_array_equal(trajectory(model, INPUTS, data), trajectory(weaker, INPUTS, reference))


def test_without_callbacks_the_motor_is_unpowered_and_keeps_its_state():
    model = rotor()
    data = mujoco.MjData(model)
    trajectory(model, INPUTS[:30], data)
    held = data.act.copy()
    engine.uninstall()
    trajectory(model, INPUTS[30:40], data)
    np.testing.assert_array_equal(data.act, held)
    assert data.qfrc_actuator[0] == 0.0


def test_the_cartpole_asset_runs_as_it_lies_on_disk():
    as_is = mujoco.MjModel.from_xml_path(str(asset_path("cartpole.xml")))
    np.testing.assert_allclose(
        trajectory(as_is, INPUTS), trajectory(cartpole(TASKS["cartpole"].paper[0]), INPUTS), rtol=1e-12, atol=1e-12
    )
