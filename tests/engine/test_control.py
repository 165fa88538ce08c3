"""The control callback runs the reference's current loop, as a pure function of model and data."""

import copy

import mujoco
import numpy as np
import pytest

from codrl_mj import engine
from codrl_mj.tasks import TASKS
from codrl_mj.user_code import asset_path
from tests.engine.models import (
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
every_integrator = pytest.mark.parametrize(
    "integrator", ["Euler", "implicitfast", "implicit", "RK4"]
)


def follow(model, data, reference, inputs):
    """Step, and compare the motor with a reference that gets the simulated velocity."""
    arm = FULL.motor.arm_radius
    for (ctrl,) in inputs:
        data.ctrl[0] = ctrl
        force = reference.step(model.opt.timestep, ctrl / arm, data.qvel[0])
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.act[STATE], reference.state, rtol=1e-11, atol=1e-12)
        assert data.act[VOLTAGE] == pytest.approx(reference.voltage, rel=1e-11, abs=1e-12)
        assert data.qfrc_actuator[0] == pytest.approx(force, rel=1e-11, abs=1e-12)


@every_integrator
def test_the_motor_is_the_reference_in_every_integrator(integrator):
    model, reference = rotor(FULL, integrator=integrator), MotorSimulation(FULL)
    follow(model, mujoco.MjData(model), reference, INPUTS)
    assert abs(reference.current) > 0.01


def test_the_cartpole_asset_runs_unchanged_from_its_file():
    as_is = mujoco.MjModel.from_xml_path(str(asset_path("cartpole.xml")))
    ours = trajectory(cartpole(TASKS["cartpole"].paper[0]), INPUTS)
    np.testing.assert_allclose(trajectory(as_is, INPUTS), ours, rtol=1e-12, atol=1e-12)


# -- a pure function of model and data -------------------------------------------------------------


@every_integrator
def test_forward_calls_with_any_control_change_nothing_between_steps(integrator):
    model, counts = rotor(integrator=integrator), np.random.default_rng(1).integers(0, 5, STEPS)

    def forward(data, index):
        desired = data.ctrl.copy()
        for control in (-3.0, *[desired] * counts[index]):
            data.ctrl[:] = control
            mujoco.mj_forward(model, data)
        data.ctrl[:] = desired

    np.testing.assert_array_equal(
        trajectory(model, INPUTS), trajectory(model, INPUTS, before_step=forward)
    )


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


def of_state(model, data):
    fresh = mujoco.MjData(model)
    mujoco.mj_setState(model, fresh, full_state(model, data), mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return fresh


def went_back(model, data):
    twin = copy.copy(data)
    trajectory(model, -INPUTS, twin)
    mujoco.mj_setState(model, twin, full_state(model, data), mujoco.mjtState.mjSTATE_FULLPHYSICS)
    return twin


def of_keyframe(model, data):
    spec = rotor_spec(
        integrator=mujoco.mjtIntegrator(model.opt.integrator).name.removeprefix("mjINT_")
    )
    spec.add_key(time=data.time, qpos=data.qpos, qvel=data.qvel, act=data.act)
    keyed = spec.compile()
    fresh = mujoco.MjData(keyed)
    mujoco.mj_resetDataKeyframe(keyed, fresh, 0)
    return fresh


@every_integrator
@pytest.mark.parametrize(
    "carried", [lambda _, data: copy.copy(data), of_state, went_back, of_keyframe]
)
def test_a_restored_state_continues_bit_for_bit(carried, integrator):
    """Check a copy, new data with the state vector, data that was set back, and a keyframe."""
    model = rotor(integrator=integrator)
    data = mujoco.MjData(model)
    trajectory(model, INPUTS[:40], data)
    twin = carried(model, data)
    rest = trajectory(model, INPUTS[40:], data)
    np.testing.assert_array_equal(rest, trajectory(twin.model, INPUTS[40:], twin))


@pytest.mark.parametrize("shift", [-0.1234, -10.0, 5.0])
def test_setting_the_clock_back_or_forward_changes_neither_motor_nor_motion(shift):
    model = rotor()
    data = mujoco.MjData(model)
    trajectory(model, INPUTS[:40], data)
    twin = copy.copy(data)
    twin.time += shift
    rest, shifted = (trajectory(model, INPUTS[40:], start) for start in (data, twin))
    np.testing.assert_array_equal(rest[:, 1:3], shifted[:, 1:3])  # position, velocity
    np.testing.assert_array_equal(rest[:, 4:], shifted[:, 4:])  # motor state but for its time


def test_the_tick_is_the_start_of_the_last_step_and_a_reset_brings_the_motor_to_rest():
    model = rotor()
    data = mujoco.MjData(model)
    first = trajectory(model, INPUTS[:7], data)
    assert data.act[TICK] == pytest.approx(0.06, abs=1e-15)
    mujoco.mj_forward(model, data)
    assert data.act[TICK] == data.time
    mujoco.mj_resetData(model, data)
    np.testing.assert_array_equal(data.act, 0.0)
    np.testing.assert_array_equal(first, trajectory(model, INPUTS[:7], data))


def test_two_simulations_of_a_model_have_separate_motors():
    model = rotor()
    expected, second = trajectory(model, INPUTS), mujoco.MjData(model)

    def step_the_other(data, _):
        second.ctrl[:] = -2.0 * data.ctrl
        mujoco.mj_step(model, second)

    np.testing.assert_array_equal(expected, trajectory(model, INPUTS, before_step=step_the_other))


def test_parameters_are_read_from_the_model_at_every_step():
    model, weaker = rotor(), rotor(changed(FULL, kp=0.5))
    data = mujoco.MjData(model)
    model.actuator_user[0] = weaker.actuator_user[0]
    np.testing.assert_array_equal(trajectory(model, INPUTS, data), trajectory(weaker, INPUTS))


# -- the control as the engine uses it -------------------------------------------------------------


def test_control_is_clamped_to_its_range_unless_clamping_is_disabled():
    model, free = rotor(max_force=1.0), rotor()  # the arm is 0.5 m: the range is +-0.5 N*m
    inputs = controls(STEPS, size=2.0)
    np.testing.assert_array_equal(
        trajectory(model, inputs), trajectory(free, inputs.clip(-0.5, 0.5))
    )
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    np.testing.assert_array_equal(trajectory(model, inputs), trajectory(free, inputs))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e11])
def test_a_nan_control_counts_as_zero(bad, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the engine writes a log
    model, inputs, zeroed = rotor(), INPUTS.copy(), INPUTS.copy()
    inputs[50:60], zeroed[50:60] = bad, 0.0
    np.testing.assert_array_equal(trajectory(model, inputs), trajectory(model, zeroed))


def disable_group(group):
    def switch(model, off):
        model.actuator_group[0], model.opt.disableactuator = group, off << group

    return switch


def disable_actuation(model, off):
    model.opt.disableflags = mujoco.mjtDisableBit.mjDSBL_ACTUATION if off else 0


def remove_callbacks(_, off):
    engine.uninstall() if off else engine.install()


@pytest.mark.parametrize(
    "switch", [disable_group(3), disable_group(0), disable_actuation, remove_callbacks]
)
def test_a_disabled_motor_has_no_force_and_holds_its_state(switch):
    model, reference = rotor(), MotorSimulation(FULL)
    data = mujoco.MjData(model)
    trajectory(model, INPUTS[:30], data)
    held = data.act.copy()
    switch(model, True)
    trajectory(model, INPUTS[30:40], data)
    np.testing.assert_array_equal(data.act, held)
    assert data.qfrc_actuator[0] == 0.0
    switch(model, False)
    reference.state = tuple(held[STATE])
    follow(model, data, reference, INPUTS[40:60])


@pytest.mark.parametrize("group", [0, 2, 5, 7, -1, 31])
def test_disabling_other_groups_does_not_affect_a_motor(group):
    model = rotor()
    expected = trajectory(model, INPUTS)
    model.actuator_group[0] = group
    model.opt.disableactuator = (1 << 6) - 1 - (1 << group if 0 <= group < 6 else 0)
    np.testing.assert_array_equal(trajectory(model, INPUTS), expected)
