"""Tests that the compiled C of a policy and of its current loop equals Python."""

import ctypes
import dataclasses
import itertools
import math
import shutil
import subprocess

import numpy as np
import pytest

from codrl_mj.actuators import DCMotorActuator, Drive, Servo, ServoLoop, Supply, electrical_step
from codrl_mj.actuators.drive import State
from codrl_mj.actuators.model import Inputs
from codrl_mj.actuators.parameters import parameters_type
from codrl_mj.deploy import Contract, extract_network
from codrl_mj.deploy.c_code import c_files, check_board
from codrl_mj.deploy.loops import loop_parameters
from codrl_mj.envs.config import EnvConfig
from tests.deploy.test_export import EACH, observed, trained
from tests.matrix import matrix_params

STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-Wconversion", "-Wpedantic")
COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
pytestmark = pytest.mark.skipif(not COMPILERS, reason="NOT RUN: no C compiler: apt-get install gcc")
KINDS = {False: ctypes.c_float, True: ctypes.c_double}


def each(names, in_float):
    """Return all names in double and one in float; the full matrix has all names in both."""
    return matrix_params(
        [(in_float, False), *((name, True) for name in names)], itertools.product(names, KINDS)
    )


def write_c(folder, task, agent="ppo", settings=(), double=False, **changes):
    """Write the C files of a policy with random weights; return the policy and its contract."""
    policy, _ = trained(task, agent, changes, **dict(settings))
    contract = Contract.from_policy(policy, EnvConfig(task, **changes), agent, 1, double=double)
    for name, content in c_files(extract_network(policy), contract).items():
        (folder / name).write_text(content)
    return policy, contract


def compiled(folder, double, *functions):
    """Compile a folder's controller as a library.

    Return the library, whose named functions return numbers, and the type of the numbers.
    """
    out = [
        "-shared",
        "-fPIC",
        str(folder / "controller.c"),
        "-lm",
        "-o",
        str(folder / "controller.so"),
    ]
    subprocess.run([COMPILERS[0], *STRICT, *out], check=True)
    library = ctypes.CDLL(out[-1])
    for name in functions:
        getattr(library, name).restype = KINDS[double]
    return library, KINDS[double]


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize(("task", "agent", "settings"), EACH)
def test_policy_in_c_equals_the_policy(tmp_path, task, agent, settings, double):
    policy, contract = write_c(tmp_path, task, agent, settings, double)
    library, kind = compiled(tmp_path, double)
    observations = observed(policy.observation_space, 2000)
    network = extract_network(policy)
    expected = (
        network(observations, np.float64)
        if double
        else policy.predict(observations, deterministic=True)[0]
    )
    command = (kind * len(contract.actions))()
    commands = np.empty((len(observations), len(contract.actions)))
    for row, observation in enumerate(observations):
        library.policy_step((kind * len(observation))(*observation.tolist()), command)
        commands[row] = command[:]
    if network.low is None:
        levels = np.array([action["levels"] for action in contract.actions]).T
        assert (commands != levels[expected]).any(axis=1).sum() <= 1
    else:
        np.testing.assert_allclose(commands, expected, atol=1e-12 if double else 1e-6, rtol=0)


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize(
    ("task", "agent"), [("furuta", "sac"), ("acrobot", "dqn"), ("acrobot", "sarsa")]
)
def test_golden_commands_are_recomputed_without_a_warning(tmp_path, compiler, task, agent):
    write_c(tmp_path, task, agent)
    program = str(tmp_path / "main")
    files = [str(tmp_path / name) for name in ("controller.c", "main.c")]
    subprocess.run(
        [compiler, *STRICT, "-fsanitize=undefined", *files, "-lm", "-o", program], check=True
    )
    process = subprocess.run([program], capture_output=True, text=True, check=False)
    assert process.returncode == 0
    assert float(process.stdout.split(": ")[1]) < 1e-6
    assert not process.stderr


LOOPS = {
    "as designed": {},
    "late": {"delayed": True},
    "clamping": {"anti_windup": "clamping"},
    "winding up": {"anti_windup": "none", "bandwidth": 300.0},
    "own gains": {"kp": 8.0, "ki": 2000.0, "bemf_compensation": False},
}


@pytest.mark.parametrize(("name", "double"), each(LOOPS, "late"))
def test_current_loop_in_c_equals_the_drives_sample_by_sample(tmp_path, name, double):
    (usual,) = EnvConfig("furuta").actuators_by_name.values()
    changed = {f"controller.{field}": value for field, value in LOOPS[name].items()}
    # The infinite inertia keeps the speed during a step, as the engine does.
    drive = usual.replaced(changed | {"motor.load_inertia": np.inf})
    motor = drive.motor
    write_c(tmp_path, "furuta", double=double, actuator=drive)
    library, kind = compiled(tmp_path, double, "current_step", "current_reference")
    state = (kind * 2)()
    library.current_reset(state)
    parameters, period = (
        parameters_type(Drive)(*drive.parameter_values),
        1.0 / drive.controller.sample_rate,
    )
    ours, decay = State(*[0.0] * 9), np.exp(-motor.resistance * period / motor.inductance)
    random = np.random.default_rng(0)
    saturated = 0
    for sample in range(2000):
        if sample % 30 == 0:
            torque, speed = random.uniform(-0.12, 0.12), random.uniform(-250.0, 250.0)
        inputs = Inputs(torque, 0.0, speed, sample * period, 0.0)
        after, _, signals = Drive.advance(parameters, period, ours, inputs)
        reference = library.current_reference(kind(torque))
        # In float, rounding errors add up in the integral, so each sample starts at equal states.
        if not double:
            state[:] = ours.integral, ours.pending
        volts = library.current_step(state, kind(reference), kind(ours.current), kind(speed))
        # The voltage's tolerance is a share of the supply voltage.
        tolerance = 1e-11 if double else 1e-6
        assert reference == pytest.approx(signals.reference_current, abs=tolerance * 10)
        assert volts == pytest.approx(signals.voltage, abs=tolerance * drive.voltage_limit)
        steady = (signals.voltage - motor.back_emf_constant * speed) / motor.resistance
        # The winding's current decays exponentially to its steady state.
        assert after.current == pytest.approx(steady + (ours.current - steady) * decay, abs=1e-9)
        saturated += signals.voltage_saturated
        ours = after
    assert 20 < saturated < 1900


PID = {
    "the paper's": {},
    "filtered": {
        "kp": 3.0,
        "ki": 15.0,
        "kd": 1e-3,
        "integral_leak": 0.4,
        "derivative_time_constant": 5e-3,
    },
    "fed forward": {"kff": 0.7, "bemf_compensation": False, "max_voltage": math.inf},
    "sagging": {"max_voltage": 9.0, "substeps": 4},
}


@pytest.mark.parametrize(("name", "double"), each(PID, "filtered"))
def test_papers_loop_in_c_equals_the_actuators_sample_by_sample(tmp_path, name, double):
    (usual,) = EnvConfig("cartpole").actuators_by_name.values()
    controller = dataclasses.replace(usual.controller, **PID[name])
    supply = Supply(12.0, 0.5) if name == "sagging" else usual.supply
    actuator = dataclasses.replace(usual, controller=controller, supply=supply)
    write_c(tmp_path, "cartpole", "dqn", double=double, actuator=actuator)
    library, kind = compiled(tmp_path, double, "current_step", "current_reference")
    parameters = parameters_type(DCMotorActuator)(*actuator.parameter_values)
    header = (tmp_path / "controller.h").read_text()
    period = 1.0 / float(
        header.partition("CONTROLLER_CURRENT_RATE ")[2].partition(" ")[0].rstrip("f")
    )
    assert period == pytest.approx(
        EnvConfig("cartpole").build().unwrapped.model.opt.timestep / controller.substeps
    )
    state, random, saturated = (kind * 2)(), np.random.default_rng(0), 0
    library.current_reset(state)
    current = integral = error = 0.0
    for sample in range(1000):
        if sample % 10 == 0:
            force, speed = random.uniform(-60.0, 60.0), random.uniform(-4.0, 4.0)
        # In float, rounding errors add up in the integral, so each sample starts at equal states.
        if not double:
            state[:] = integral, error
        available = min(controller.max_voltage, math.inf if supply is None else supply.voltage)
        if name == "sagging":
            available = min(
                controller.max_voltage, max(supply.voltage - supply.resistance * abs(current), 0.0)
            )
        reference = kind(library.current_reference(kind(force)))
        volts = library.current_step(state, reference, kind(current), kind(speed))
        torque = force * actuator.arm_radius
        arguments = parameters, period, current, integral, error, torque, speed, 0.0, available
        current, integral, error, expected = electrical_step(*arguments)
        assert volts == pytest.approx(
            expected, rel=1e-12 if double else 1e-5, abs=1e-11 if double else 2e-5
        )
        saturated += abs(expected) == available
    assert (saturated > 20) == (name != "fed forward")
    assert list(state) == pytest.approx(
        [integral, error], rel=1e-9 if double else 1e-4, abs=1e-9 if double else 1e-4
    )


SERVOS = {
    "position": {
        "velocity_gain": 0.02,
        "position_gain": 15.0,
        "velocity_integral_gain": 3.0,
        "max_torque": 0.2,
    },
    "ahead": {
        "velocity_gain": 0.005,
        "position_gain": 4.0,
        "velocity_feed_forward": 0.9,
        "max_velocity": 8.0,
    },
    "velocity": {
        "controls": "velocity",
        "velocity_gain": 0.01,
        "inertia_feed_forward": 2e-5,
        "max_torque": 0.1,
    },
}


@pytest.mark.parametrize(("name", "double"), each(SERVOS, "position"))
def test_servo_loops_in_c_equal_the_servos_sample_by_sample(tmp_path, name, double):
    (drive,) = EnvConfig("furuta").actuators_by_name.values()
    loop = ServoLoop(servo_rate=500.0, **SERVOS[name])
    servo = Servo(
        dataclasses.replace(drive.motor, gear_ratio=3.0), drive.controller, drive.supply, loop
    )
    write_c(tmp_path, "furuta", double=double, actuator=servo, action=loop.controls)
    library, kind = compiled(tmp_path, double, "servo_step", "servo_target")
    assert library.servo_target(kind(0.5)) == pytest.approx(0.5 * 3.0)
    state, random, limited, free = (kind * 1)(), np.random.default_rng(0), 0, 0
    library.servo_reset(state)
    parameters, period = parameters_type(Servo)(*servo.parameter_values), 1.0 / loop.servo_rate
    ours, position, speed = Servo.State(*[0.0] * len(Servo.State._fields)), 0.0, 0.0
    for sample in range(1000):
        if sample % 50 == 0:
            target = (
                random.uniform(-6.0, 6.0)
                if loop.controls == "position"
                else random.uniform(-30.0, 30.0)
            )
        target += random.uniform(-0.01, 0.01)
        position, speed = 0.9 * position + random.uniform(-1.0, 1.0), random.uniform(-20.0, 20.0)
        rate = (target - ours.target) / period if ours.expected_time > 0.0 else 0.0
        if not double:
            state[0] = ours.velocity_integral
        inputs = Inputs(target, position, speed, sample * period, 0.0)
        ours, _, signals = Servo.advance(parameters, period, ours, inputs)
        reference = library.servo_step(state, kind(target), kind(rate), kind(position), kind(speed))
        assert reference == pytest.approx(
            signals.reference_current, rel=0, abs=1e-12 if double else 5e-6
        )
        assert state[0] == pytest.approx(
            ours.velocity_integral, rel=0, abs=1e-12 if double else 1e-7
        )
        limited += signals.current_saturated
        free += not signals.current_saturated
    assert min(limited, free) > (50 if loop.max_torque < math.inf else -1)


@pytest.mark.parametrize(
    ("task", "changes"),
    [
        ("cartpole", {"actuator": "ideal"}),
        ("mountain_car_continuous", {"action": "voltage"}),
        ("furuta", {"action": "voltage"}),
    ],
)
def test_c_has_only_the_policy_without_a_current_loop(tmp_path, task, changes):
    assert loop_parameters(EnvConfig(task, **changes)) is None
    write_c(tmp_path, task, **changes)
    assert "current_step" not in (tmp_path / "controller.h").read_text()


MLP, SARSA = ("pendulum", "ppo"), ("acrobot", "sarsa")


@pytest.mark.parametrize(
    ("board", "policy", "hidden", "double", "message"),
    [
        (
            "arduino-uno",
            MLP,
            128,
            False,
            r"arduino-uno: .* needs about \d+ bytes of flash, must be at most 32256",
        ),
        (
            "arduino-uno",
            MLP,
            48,
            False,
            r"arduino-uno: .* needs about 1\d+ bytes of RAM, must be at most 2048",
        ),
        ("arduino-uno", MLP, 48, True, "double has 4 bytes"),
        (
            "arduino-uno",
            SARSA,
            None,
            False,
            r"train a smaller one \(--agent.tilings 4\), or name a larger",
        ),
        ("arduino-un", MLP, 48, False, "did you mean arduino-uno"),
    ],
)
def test_raises_with_both_sizes_if_a_policy_does_not_fit(board, policy, hidden, double, message):
    network = extract_network(
        trained(*policy, **({"hidden": (hidden, hidden)} if hidden else {}))[0]
    )
    check_board("nucleo-f446re", network, double=False)
    with pytest.raises(ValueError, match=message):
        check_board(board, network, double)
