"""Tests that every check of the motor fails if the motor is wrong."""

import ast
import dataclasses
import math
import sys
from pathlib import Path

import control
import mujoco
import numpy as np
import pytest
from scipy import integrate, signal

from codrl_mj.actuators import FAMILIES, CurrentLoop, DCMotorActuator, Motor, Supply
from codrl_mj.validation import motor, motor_catalogue, motor_loops, own_model, rotors
from codrl_mj.validation.motor_loops import closed_form, closed_loop, sampled_system
from codrl_mj.validation.rotors import EVERY_FEATURE, Loop, standard_loops
from codrl_mj.validation.table import Skipped
from tests.reference import of_actuator
from tests.validation.mutations import entry

pytestmark = pytest.mark.usefixtures("bare_engine")

SMALL = {"small": motor.MOTORS["small"]}
ORDER, LIMIT = "closed form, order in the substeps", "closed form, limit of small substeps"
SAMPLED, STEP = "sampled loop, random torques and speeds", "step response"
MAGNITUDE, PHASE = "frequency response, magnitude", "frequency response, phase"
VOLTAGE = "stall torque at the voltage limit"
LINE, NO_LOAD = "torque-speed line and power, stall to regeneration", "no-load speed and current"
MAP, SUB = "native <dcmotor>, same map", "native <dcmotor>, Euler, order in the substeps"
FAST, RK4 = "native <dcmotor>, implicitfast, order in the step", "RK4, locked rotor"
GEM = "gym-electric-motor, order in the step"
LOOP = {ORDER, LIMIT, SAMPLED, STEP, MAGNITUDE, PHASE}
NATIVE = {MAP, SUB, FAST}
COMPILED = {
    f"compiled advance: {kind}"
    for kind in (
        "DCMotorActuator",
        "VoltageDriven",
        "Drive",
        "VoltageDrive",
        "SharedDrive",
        "SharedVoltageDrive",
        "Servo",
        "PwmServo",
        "Lag",
        "TorqueSpeed",
    )
}
DRIVES = {"drives, exact winding", "drives, closed form"}
EVERY = LOOP | {VOLTAGE, LINE, NO_LOAD, RK4, GEM} | NATIVE | COMPILED | DRIVES


MINE = {"every feature": EVERY_FEATURE}
MOTORS = {"every feature": EVERY_FEATURE.actuator.motor}
# Names of checks, and a function that runs them with a few loops and motors only.
RUNS = (
    ({ORDER, LIMIT}, lambda: motor.order_to_closed_form(MINE, quick=True)),
    ({SAMPLED, STEP, MAGNITUDE, PHASE}, lambda: motor.sampled_checks(MINE, quick=True)),
    ({VOLTAGE}, lambda: motor.voltage_limit(MINE)),
    ({LINE}, lambda: motor.torque_speed_line(MOTORS)),
    ({NO_LOAD}, lambda: motor.no_load(MOTORS)),
    ({MAP}, lambda: motor.equal_to_native(SMALL, quick=True)),
    ({SUB}, lambda: motor.order_in_substeps(SMALL, quick=True)),
    ({FAST}, lambda: motor.order_under_implicitfast(SMALL, quick=True)),
    (COMPILED, lambda: own_model.compiled_checks(quick=True)),
    ({RK4}, lambda: motor.rk4_check(quick=True)),
    ({GEM}, lambda: motor.gem_check(Motor(), quick=True)),
    (DRIVES, lambda: motor_catalogue.drive_checks(quick=True)),
)


def failed(names):
    """Run the named checks, and those of the same functions, and return the names that fail."""
    checks = [check for available, run in RUNS if available & names for check in run()]
    return {check.name for check in checks if not check.passed}


def mutate(monkeypatch, change):
    """Apply `change(user data, gear)`, with rows by motor, to every model with codrl_mj motors."""
    install = rotors.install_callbacks

    def wrong(model):
        install(model)
        change(model.actuator_user, model.actuator_gear)

    monkeypatch.setattr(rotors, "install_callbacks", wrong)


def scaled(parameter, factor):
    def change(user, _):
        user[:, entry(parameter)] *= factor

    return change


def swapped(user, _):
    user[:, [entry("kp"), entry("ki")]] = user[:, [entry("ki"), entry("kp")]]


def longer_gear(_, gear):
    gear *= 1.01


def one_substep(user, _):
    user[:, entry("substeps")] = 1


MUTATIONS = {
    "inductance + 0.1 %": (scaled("inductance", 1.001), LOOP | {MAP, SUB}),
    "resistance + 1 %": (scaled("resistance", 1.01), EVERY - {NO_LOAD}),
    "torque constant + 1 %": (scaled("torque_constant", 1.01), {VOLTAGE, LINE} | NATIVE | {GEM}),
    "back-EMF reversed": (
        scaled("back_emf_constant", -1),
        {ORDER, LIMIT, SAMPLED, LINE, NO_LOAD, GEM} | NATIVE,
    ),
    "kp and ki swapped": (swapped, LOOP),
    "kp + 0.1 %": (scaled("kp", 1.001), LOOP),
    "ki + 1 %": (scaled("ki", 1.01), LOOP),
    "kd doubled": (scaled("kd", 2.0), LOOP),
    "kff + 0.1 %": (scaled("kff", 1.001), LOOP | NATIVE | {RK4, GEM}),
    "voltage limit - 1 %": (scaled("max_voltage", 0.99), {VOLTAGE}),
    "gear + 1 %": (longer_gear, LOOP - {PHASE} | {VOLTAGE, LINE, NO_LOAD, GEM} | NATIVE),
    "substeps ignored": (one_substep, {ORDER, LIMIT, SAMPLED, SUB}),
}
"""Name -> (fault, checks that must fail; others may fail)."""


@pytest.mark.parametrize("mutation", MUTATIONS)
def test_wrong_motor_fails(monkeypatch, mutation):
    change, must_fail = MUTATIONS[mutation]
    mutate(monkeypatch, change)
    assert must_fail <= failed(must_fail)


def test_every_family_is_compared_with_plain_python():
    names = {f"compiled advance: {kind.__name__}" for kind in FAMILIES.values()}
    assert names - COMPILED == {"compiled advance: Ideal"}, (
        "only the ideal actuator has no callback"
    )


def test_every_check_is_failed_by_some_mutation():
    assert set().union(*(must_fail for _, must_fail in MUTATIONS.values())) == EVERY


def test_command_one_step_late_fails(monkeypatch):
    step, waiting = mujoco.mj_step, {}

    def late(model, data):
        _, command = waiting.get(id(data), (data, np.zeros_like(data.ctrl)))
        # A reference to the data is kept, so that their id is not used for other data.
        waiting[id(data)] = (
            data,
            data.ctrl.copy(),
        )
        data.ctrl[:] = command
        step(model, data)

    monkeypatch.setattr(rotors.mujoco, "mj_step", late)
    # The native motor's command is also late, so comparisons with it do not fail.
    assert failed({SAMPLED, LIMIT}) >= {SAMPLED, STEP, PHASE, LIMIT}


def test_loop_of_a_task_is_checked(monkeypatch):
    monkeypatch.setattr(motor, "loop_checks", lambda loops, _: iter([list(loops)]))
    assert next(motor.checks("cartpole", quick=True)) == ["cartpole"]


def test_checks_without_a_voltage_limit_and_a_back_emf():
    quiet = DCMotorActuator(Motor(back_emf_constant=0.0), CurrentLoop(max_voltage=math.inf))
    names = {
        check.name: check for check in motor.loop_checks({"mine": Loop(quiet, 0.01)}, quick=True)
    }
    assert names.keys() == LOOP | {LINE}
    assert all(check.passed for check in names.values())


@pytest.mark.parametrize("supply", [Supply(12.0), Supply(24.0, 0.5), Supply(np.inf, 0.5), None])
def test_stall_torque_is_limited_by_the_supply(supply):
    actuator = DCMotorActuator(controller=CurrentLoop(kp=2.0, ki=5.0), supply=supply)
    checks = {
        check.name: check for check in motor.loop_checks({"mine": Loop(actuator, 0.01)}, quick=True)
    }
    assert checks["stall torque at the voltage limit"].passed


def test_stiff_motor_passes_with_its_substeps():
    stiff = DCMotorActuator(
        Motor(
            resistance=0.5,
            inductance=2e-4,
            torque_constant=0.05,
            back_emf_constant=0.05,
            arm_radius=0.02,
        ),
        CurrentLoop(kp=0.5, ki=800.0, substeps=40),
    )
    for check in motor.loop_checks({"mine": Loop(stiff, 0.01)}, quick=True):
        assert check.passed, check


# -- the oracles -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*standard_loops()])
def test_sampled_oracles_equal_the_papers_equations(name):
    """Check that state space, blocks and plain Python are the same system."""
    actuator, timestep = standard_loops()[name]
    m, c = actuator.motor, dataclasses.replace(actuator.controller, substeps=1)
    actuator = DCMotorActuator(m, c)
    step = of_actuator(DCMotorActuator(dataclasses.replace(m, arm_radius=1.0), c))
    state, currents = (0.0, 0.0, 0.0), []
    for _ in range(50):
        *state, _, _ = step(timestep, *state, m.torque_constant, 0.0)
        currents.append(state[0])
    _, sampled, _ = signal.dlsim(sampled_system(actuator, timestep), np.tile([1.0, 0.0], (50, 1)))
    np.testing.assert_allclose(sampled[:, 0], currents, rtol=0, atol=1e-12)
    blocks = control.step_response(closed_loop(actuator, timestep), np.arange(51) * timestep)
    np.testing.assert_allclose(np.ravel(blocks.outputs)[1:], currents, rtol=0, atol=1e-10)


def test_closed_form_solves_the_circuits_equations():
    """Compare with scipy's integrator, on a loop without a derivative gain."""
    actuator = DCMotorActuator(
        Motor(inductance=0.05, back_emf_constant=0.7),
        CurrentLoop(kp=2, ki=5, bemf_compensation=False),
    )

    def derivative(_, state):
        current, integral = state
        voltage = 2.0 * (1.0 - current) + 5.0 * integral
        return [(voltage - 0.7 * 0.4 - current) / 0.05, 1.0 - current]

    times = 0.02 * np.arange(1, 41)
    solved = integrate.solve_ivp(
        derivative, (0, times[-1]), [0, 0], "DOP853", times, rtol=1e-12, atol=1e-12
    )
    # scipy interpolates between its steps with an error of 1e-8.
    np.testing.assert_allclose(
        closed_form(actuator, 0.02, np.ones(40), 0.4),
        solved.y[0],
        rtol=0,
        atol=1e-8,
    )


def test_oracles_import_no_functions_of_the_actuators():
    """Check that the oracles import only the classes with the parameters."""
    classes = {"Motor", "CurrentLoop", "DCMotorActuator"}
    for path in map(Path, (motor.__file__, motor_loops.__file__)):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module.startswith("codrl_mj.actuators"):
                assert {alias.name for alias in node.names} <= classes, path


def test_native_motor_is_wrong_under_rk4_and_ours_is_not():
    (check,) = motor.rk4_check(quick=True)
    ours, native = check.plots[0].curves
    assert ours.y.max() < 1e-12
    assert native.y[0] > 0.02
    assert native.y[-1] > 0.3


def test_check_is_skipped_without_gym_electric_motor(monkeypatch):
    for name in ("loop_checks", "compiled_checks", "drive_checks"):
        monkeypatch.setattr(motor, name, lambda *_: iter(()))
    monkeypatch.setattr(motor, "MOTORS", SMALL)
    monkeypatch.setitem(sys.modules, "gym_electric_motor", None)
    *completed, skipped = motor.checks(quick=True)
    assert {check.name for check in completed} == NATIVE | {RK4}
    assert skipped == Skipped(skipped.name, "gym-electric-motor is not installed")
