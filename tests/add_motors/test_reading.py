"""Motors and signals are read from models and data with both backends."""

import re

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Lag, TorqueSpeed
from codrl_mj.physics.mjcf import configure_actuator, install_callbacks
from tests.add_motors.models import LOOP, arm, behind_callback, behind_plugin

pytestmark = pytest.mark.usefixtures("bare_engine")

LINE = TorqueSpeed(stall_torque=0.8, no_load_speed=3.0, max_torque=0.3)


def _mixed():
    """Return a model with a motor in each backend, and an actuator without a motor."""
    spec = arm()
    spec.add_actuator(name="plain", target="lower", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    configure_actuator(spec.actuator("one"), LOOP, 1.0)
    model = codrl_mj.add_motors(spec, {"two": LINE}).compile()
    install_callbacks(model)
    return model


def test_motors_returns_those_of_both_backends_or_none():
    assert codrl_mj.engine.motors(_mixed()) == {0: LOOP, 1: LINE}
    plain = arm().compile()
    assert codrl_mj.engine.motors(plain) == {}
    signals = codrl_mj.signals(plain, mujoco.MjData(plain))
    assert {name: values.shape for name, values in signals.items()} == {
        "desired_force": (0,),
        "actual_force": (0,),
    }


def test_signals_of_both_backends_are_read():
    model = _mixed()
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.15, 0.5, 0.1
    mujoco.mj_step(model, data, 3)
    mujoco.mj_forward(model, data)
    signals = codrl_mj.signals(model, data)
    gear = 1 / LOOP.arm_radius
    assert list(signals) == [
        *("desired_force", "actual_force", "current", "reference_current", "voltage", "saturated"),
        *("lower_limit", "upper_limit"),
    ]
    np.testing.assert_allclose(signals["desired_force"], [0.15 * gear, 0.5], rtol=1e-15)
    kt = LOOP.motor.torque_constant
    np.testing.assert_allclose(
        signals["actual_force"], [kt * signals["current"][0] * gear, 0.3], rtol=1e-15
    )
    np.testing.assert_allclose(signals["reference_current"], [0.15 / kt, np.nan])
    np.testing.assert_array_equal(signals["saturated"], [0.0, 1.0])
    np.testing.assert_array_equal(signals["upper_limit"], [np.nan, 0.3])
    assert signals["voltage"][0] != 0.0
    np.testing.assert_allclose(data.qfrc_actuator, [signals["actual_force"][0], 0.3 + 0.1])


def test_desired_forces_use_clipped_controls():
    """A source without lag delivers the desired force, so the engine's force tells it."""
    source = Lag(time_constant=0.0)
    for build in (behind_callback, behind_plugin):
        model = build(arm(), {"one": source, "two": source})
        model.actuator_ctrllimited[:], model.actuator_ctrlrange[:] = True, (-0.4, 0.5)
        data, readout = mujoco.MjData(model), codrl_mj.engine.Readout(model)
        data.ctrl[:] = 0.9, -0.7
        for flags, expected in (
            (0, [0.5, -0.4]),
            (mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL, [0.9, -0.7]),
        ):
            model.opt.disableflags = flags
            mujoco.mj_step(model, data)
            signals = readout(data)
            np.testing.assert_array_equal(signals["desired_force"], expected)
            np.testing.assert_array_equal(signals["actual_force"], expected)


def test_desired_and_actual_force_are_before_the_models_own_gear():
    spec = arm()
    spec.actuator("one").gear = [50.0, 0, 0, 0, 0, 0]
    model = codrl_mj.add_motors(spec, {"one": Lag(time_constant=0.0)}).compile()
    data = mujoco.MjData(model)
    data.ctrl[0] = 0.25
    mujoco.mj_forward(model, data)
    assert {name: float(value[0]) for name, value in codrl_mj.signals(model, data).items()} == {
        "desired_force": 0.25,
        "actual_force": 0.25,
    }
    assert data.qfrc_actuator[0] == 12.5


@pytest.mark.parametrize("key", [-1, 1.5, 2**53, np.nan, np.inf, "7", None])
def test_clear_motors_brings_both_backends_to_rest_and_an_invalid_key_changes_nothing(
    key,
):
    model = _mixed()
    data = mujoco.MjData(model)
    codrl_mj.engine.clear_motors(data, np.array([2**53 - 1, 8]))
    data.ctrl[:] = 0.15, 0.5, 0.1
    mujoco.mj_step(model, data, 10)
    assert codrl_mj.signals(model, data)["current"][0] != 0.0
    before = np.concatenate((data.act, data.plugin_state))
    message = f"noise_keys[1] = {key!r}: must be a whole number from 0 to 2**53 - 1"
    with pytest.raises(ValueError, match=re.escape(message)):
        codrl_mj.engine.clear_motors(data, [3, key])
    with pytest.raises(ValueError, match="got 1 keys, must be 2: one for each motor"):
        codrl_mj.engine.clear_motors(data, 7)
    np.testing.assert_array_equal(np.concatenate((data.act, data.plugin_state)), before)
    codrl_mj.engine.clear_motors(data)
    states = np.concatenate((data.act, data.plugin_state))
    assert states[states != 0.0].tolist() == [data.time, 2.0**53 - 1, data.time, 8.0]
