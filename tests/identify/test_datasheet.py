"""A geared catalog motor: simulated by MuJoCo, identified with its datasheet, and replayed."""

import mujoco
import numpy as np
import pytest

import codrl_mj
from codrl_mj.actuators import Drive, resolve
from codrl_mj.catalogue import motor_entry
from codrl_mj.identify import Log, identify

MX = Drive.from_motor_parameters(motor_entry("dynamixel-mx-64").parameters)
MASS, ARM = 0.6, 0.15
MGL, LOAD = MASS * 9.81 * ARM, MASS * ARM**2
STEP, ROWS = 5e-4, 4


def simulate_pendulum(drive, volts, name="swing"):
    """Return a log of a pendulum in MuJoCo, at steps of 0.5 ms, under voltages [V] of 2 ms each."""
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><option timestep="{STEP}"/><worldbody><body><joint name="hinge" axis="0 1 0"/>
        <inertial mass="{MASS}" pos="0 0 {-ARM}" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody>
        <actuator><motor name="motor" joint="hinge" ctrlrange="-999 999"/></actuator></mujoco>"""
    )
    command = drive.commands()["voltage"]
    model = codrl_mj.add_motors(spec, {"motor": command.actuator}).compile()
    data, position = mujoco.MjData(model), np.empty(len(volts))
    for row, volt in enumerate(volts):
        position[row] = data.qpos[0]
        data.ctrl[0] = volt * command.torque_per_unit * drive.motor.gear_ratio
        mujoco.mj_step(model, data, ROWS)
    time = STEP * ROWS * np.arange(len(volts))
    return Log(name, time, {"voltage": np.asarray(volts), "position": position})


def random_voltages(seed, duration=3.0):
    """Return a slow sine plus random steps [V]."""
    random, time = (
        np.random.default_rng(seed),
        np.arange(round(duration / STEP / ROWS)) * STEP * ROWS,
    )
    steps = np.repeat(random.uniform(-4.0, 4.0, 1 + len(time) // 50), 50)[: len(time)]
    return 3.0 * np.sin(2.0 * np.pi * 0.7 * time + seed) + steps


@pytest.fixture(scope="module")
def swings():
    return [simulate_pendulum(MX, random_voltages(seed), f"swing{seed}") for seed in (1, 2)]


@pytest.fixture(scope="module")
def geared(swings):
    known = {"mgl": MGL, "load_inertia": LOAD, "resistance": MX.motor.resistance}
    return identify(swings[:1], "pendulum", known, held_out=swings[1:], base=MX.as_mapping())


def test_a_geared_motor_is_identified_with_its_datasheet(geared):
    """The fit has to use the datasheet's efficiency: with 1 the constant would be 15 % off."""
    truth = {"torque_constant": MX.motor.torque_constant, "rotor_inertia": MX.motor.rotor_inertia}
    truth["inertia"] = LOAD + MX.motor.rotor_inertia * MX.motor.gear_ratio**2
    for name, value in truth.items():
        assert geared[name].low < value < geared[name].high
        assert geared[name].value == pytest.approx(value, rel=0.02)
    assert geared["gear_efficiency"].value == MX.motor.gear_efficiency
    assert geared["gear_efficiency"].status == "given"
    assert geared.actuator().motor.gear_efficiency == MX.motor.gear_efficiency
    assert geared.warnings == ()
    assert "inductance = 0.0002927 H" in geared.base_text


def test_the_written_actuator_reproduces_the_prediction(geared, swings, tmp_path):
    """A simulation of the whole log has the reported error: friction is not applied twice."""
    path, _ = geared.write(tmp_path)
    log = swings[1]
    replayed = simulate_pendulum(resolve(str(path), None, "a test"), log.signals["voltage"])
    error = np.abs(replayed.signals["position"] - log.signals["position"]).mean()
    assert error < 3.0 * geared.held_out[0].open_loop < 3e-3


def test_a_wrong_efficiency_of_the_datasheet_gives_a_hint(swings):
    base = MX.replaced({"motor.gear_efficiency": 0.5}).as_mapping()
    known = {"mgl": MGL, "load_inertia": LOAD, "resistance": MX.motor.resistance}
    result = identify(swings[:1], "pendulum", known, base=base)
    (hint,) = (text for text in result.warnings if "--friction load" in text)
    assert "instead of 0.5" in hint
