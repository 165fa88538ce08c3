"""Tests of the exported C as the controller, on this machine and on an emulated board."""

import binascii
import ctypes
import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from codrl_mj.actuators import CurrentLoop, DCMotorActuator, Motor, Servo, ServoLoop
from codrl_mj.agents import DQNConfig, SACConfig
from codrl_mj.cli import main
from codrl_mj.deploy import (
    Board,
    Contract,
    Link,
    OnnxPolicy,
    board_test,
    check_log,
    export,
    instructions,
)
from codrl_mj.deploy import board as boards
from codrl_mj.deploy.board import TARGETS, missing_tools
from codrl_mj.deploy.wire import Wire
from codrl_mj.envs.config import EnvConfig
from codrl_mj.tasks import TASKS
from tests.deploy.test_export import trained
from tests.deploy.test_run import with_sensors
from tests.matrix import matrix_params

pytestmark = pytest.mark.skipif(
    bool(missing_tools("host")), reason="NOT RUN: no C compiler: apt-get install gcc"
)
ON = [
    pytest.param(
        name,
        marks=pytest.mark.skipif(
            bool(missing_tools(name)), reason=f"NOT RUN: {missing_tools(name)}"
        ),
    )
    for name in TARGETS
]
OK, DAMAGED, OLD, NOT_FINITE, LATE, BEYOND, NO_SENSORS = 0, 1, 2, 4, 8, 16, 32
AGENTS = {"furuta": "ppo", "cartpole": "dqn"}
of_furuta, of_cartpole = (
    pytest.mark.parametrize("folder", [task], indirect=True) for task in AGENTS
)


@pytest.fixture(scope="module", params=AGENTS)
def folder(request, tmp_path_factory):
    """Export a policy with random weights, in float or in double."""
    task = request.param
    out = tmp_path_factory.mktemp("exported") / task
    export(
        trained(task, AGENTS[task])[0],
        EnvConfig(task),
        AGENTS[task],
        out,
        1,
        double=task == "cartpole",
    )
    return out


@pytest.fixture(scope="module", autouse=True)
def _compiled_once(tmp_path_factory):
    """Compile the same C for the same target only once in this file."""
    programs, build = {}, boards._build

    def build_once(folder, target, _, flags):
        key = (target, *flags, *(path.read_bytes() for path in sorted(folder.glob("*.[ch]"))))
        if key not in programs:
            programs[key] = build(folder, target, tmp_path_factory.mktemp("built"), flags)
        return programs[key]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(boards, "_build", build_once)
        yield


@pytest.mark.parametrize("target", ON)
def test_episodes_on_the_board_equal_those_of_onnxruntime(folder, target):
    result = board_test(folder, target, 3, seed=5)
    assert result.frames == sum(len(episode.time) for episode in result.on_board)
    assert (result.refused, result.unanswered, result.num_equal_returns) == (0, 0, 3)
    np.testing.assert_allclose(result.returns[:, 0], result.returns[:, 1], rtol=1e-3)


def insert_text(folder, out, before, inserted, file="controller.c"):
    """Copy an exported folder with a text inserted into its C."""
    shutil.copytree(folder, out, dirs_exist_ok=True)
    begin, line, rest = (folder / file).read_text().partition(before)
    assert line
    (out / file).write_text(f"{begin}{line}{inserted}{rest}")
    return out


@of_furuta
def test_changed_weight_in_the_c_changes_the_actions(folder, tmp_path):
    result = board_test(insert_text(folder, tmp_path, "bias_0[64] = {", "9.0f + "), episodes=1)
    assert not np.array_equal(result.on_board[0].action, result.in_python[0].action)


@pytest.mark.parametrize("folder", matrix_params(["furuta"], AGENTS), indirect=True)
def test_changed_gain_in_the_c_changes_the_motor_current(folder, tmp_path):
    errors = []
    for tested in (folder, insert_text(folder, tmp_path, "  const real asked = ", "0.001f * ")):
        result = board_test(tested, episodes=1)
        assert result.samples > 0
        ours, oracle = (
            side[0].signals["current"][:20] for side in (result.on_board, result.in_python)
        )
        errors.append(
            (np.abs(ours - oracle).max(), abs(result.returns[0, 0] - result.returns[0, 1]))
        )
    (original_current, original_return), (changed_current, changed_return) = errors
    assert original_current < 1e-4 < 1e-3 < changed_current
    assert original_return < changed_return
    assert board_test(tmp_path, episodes=1, loop=False).samples == 0


FURUTA = EnvConfig("furuta")
(DRIVE,) = FURUTA.actuators_by_name.values()
CLAMPING = DRIVE.replaced({"controller.anti_windup": "clamping"})
LATE_AND_SAGGING = {
    "controller.delayed": True,
    "controller.deadband": 0.3,
    "supply.resistance": 1.5,
}
OWN_GAINS = {"controller.kp": 6.0, "controller.ki": 900.0}
GEARED = {
    "motor.thermal_resistance_winding": 5.0,
    "motor.gear_efficiency": 0.8,
    "motor.stribeck_friction": 1e-3,
}
LOOPS = {
    "late, with a dead band, sagging, clamping": CLAMPING.replaced(LATE_AND_SAGGING),
    "own gains, warming, geared": DRIVE.replaced(OWN_GAINS | GEARED),
    "servo": Servo(
        DRIVE.motor,
        DRIVE.controller,
        DRIVE.supply,
        ServoLoop(servo_rate=500.0, velocity_gain=0.004),
    ),
    "the paper's": DCMotorActuator(
        Motor(), CurrentLoop(kp=2.0, ki=5.0, kd=1e-4, substeps=3, current_bias=0.02, kff=0.1)
    ),
}


@pytest.mark.parametrize("name", LOOPS)
def test_motor_with_its_loop_on_the_board_moves_as_in_the_simulation(name, tmp_path):
    env = EnvConfig(
        "furuta", actuator=LOOPS[name], action="position" if name == "servo" else "force"
    )
    policy, simulation = trained("furuta", "ppo")[0], env.build()
    policy.action_space = simulation.action_space
    export(policy, env, "ppo", tmp_path / "out", 1, double=True)
    random = np.random.default_rng(0)
    actions = random.uniform(
        simulation.action_space.low, simulation.action_space.high, (60, 1)
    ).astype(np.float32)

    def run():
        simulation.reset(seed=0)
        steps = [simulation.step(action) for action in actions]
        keys = ("current", "voltage", "actual_force")
        return np.array([observation for observation, *_ in steps]), np.array(
            [[info[key] for key in keys] for *_, info in steps]
        )

    with Board(tmp_path / "out") as board:
        observations, signals = run()
        assert board.samples >= 60 * (30 if name == "the paper's" else 400)
    expected_observations, expected_signals = run()
    np.testing.assert_allclose(signals, expected_signals, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(observations, expected_observations, rtol=1e-6, atol=1e-6)


@of_cartpole
def test_voltages_are_rounded_to_the_bits_of_the_bridge(folder):
    result = board_test(folder, episodes=1, link=Link(pwm_bits=6, current_bits=8))
    steps = result.on_board[0].signals["voltage"] / (2.0 * 24.0 / 2**6)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert not np.allclose(result.in_python[0].signals["voltage"] % 0.75, 0.0)


LIMITED = {"name": "paper", "controller": {"max_voltage": 12.0}}
VOLTS = {
    "pendulum": (EnvConfig("pendulum", LIMITED, action="voltage"), SACConfig(hidden=(8,))),
    "cartpole": (
        EnvConfig("cartpole", LIMITED, action="voltage", levels=(-5, -1.3, 0.7, 5)),
        DQNConfig(hidden=(8,)),
    ),
}


@pytest.mark.parametrize("task", VOLTS)
def test_bridge_rounds_the_voltages_of_a_policy_that_commands_them(tmp_path, task):
    env, agent = VOLTS[task]
    with env.build() as simulation:
        policy = agent.make_policy(simulation.observation_space, simulation.action_space)
    export(policy, env, agent.name, tmp_path / "out", 1)
    step = 2.0 * 12.0 / 2**5
    result = board_test(tmp_path / "out", episodes=1, link=Link(pwm_bits=5))
    exact, coarse = (
        side[0].signals["voltage"] / step for side in (result.in_python, result.on_board)
    )
    np.testing.assert_allclose(coarse, np.round(coarse), atol=1e-9)
    assert not np.allclose(exact, np.round(exact), atol=1e-3)
    # The log has the policy's unrounded commands, which `board check` computes again.
    contract = Contract.read(tmp_path / "out")
    commanded = contract.to_commands(result.on_board[0].action).ravel() / step
    np.testing.assert_allclose(coarse, np.round(commanded), atol=1e-6)
    with pytest.raises(
        ValueError, match="the policy commands voltages, and the C code measures no current"
    ):
        board_test(tmp_path / "out", episodes=1, link=Link(pwm_bits=8, current_bits=8))


def test_raises_for_pwm_bits_without_a_loop_or_a_voltage(tmp_path):
    export(
        trained("pendulum", "ddpg")[0], EnvConfig("pendulum", "lag"), "ddpg", tmp_path / "out", 1
    )
    with pytest.raises(
        ValueError,
        match="must be 0: the C code neither closes a current loop nor commands a voltage",
    ):
        board_test(tmp_path / "out", episodes=1, link=Link(pwm_bits=8))


def forget():
    """Remove the example's module and its task, as in a new process."""
    sys.modules.pop("ball_and_beam", None)
    if "ball_and_beam" in TASKS:
        gym.registry.pop(TASKS.pop("ball_and_beam").env_id)


def test_contract_that_names_a_module_needs_trust(tmp_path, monkeypatch, capsys, request):
    example = Path(__file__).parents[2] / "examples/own_robot"
    shutil.copytree(example, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    request.addfinalizer(forget)
    forget()
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    with monkeypatch.context() as patched:
        patched.syspath_prepend(tmp_path)
        env = EnvConfig("ball_and_beam:TASK", max_episode_steps=20)
        export(trained("ball_and_beam:TASK", "ppo")[0], env, "ppo", tmp_path / "out", 1)
    for line in (
        ["board", "test", "out", "--log", "a.csv"],
        ["identify", "compare", "out", "a.csv"],
    ):
        forget()
        monkeypatch.setattr(sys, "path", [path for path in sys.path if path != str(tmp_path)])
        options = ["--episodes", "1"] if line[0] == "board" else []
        assert main([*line, *options]) == 2
        assert "'ball_and_beam:TASK': needs the module ball_and_beam" in capsys.readouterr().err
        assert "ball_and_beam" not in sys.modules
        assert main([*line, *options, "--trust"]) == 0
    with pytest.raises(ValueError, match="trust=True"):
        board_test(tmp_path / "out", episodes=1)
    assert board_test(tmp_path / "out", episodes=1, trust=True).num_equal_returns == 1


@of_furuta
def test_encoders_round_angles_and_late_answers_delay_commands(folder):
    contract, step = Contract.read(folder), 2.0 * np.pi / 2048
    row = np.array(contract.golden["observations"][50])
    measured = Link(counts=2048).quantize(contract, row)
    for index in (0, 2):
        angle = np.arctan2(measured[index + 1], measured[index])
        assert angle / step == pytest.approx(round(angle / step), abs=1e-9)
        assert abs(angle - np.arctan2(row[index + 1], row[index])) <= 0.51 * step
    np.testing.assert_allclose(
        measured[4:] / (step * 50.0), np.round(row[4:] / (step * 50.0)), atol=1e-9
    )
    rows = np.array(contract.golden["observations"])
    with Board(folder, link=Link(late=1.0)) as late, Board(folder) as prompt:
        late_commands = [late.command(row) for row in rows]
        commands = [prompt.command(row) for row in rows]
    np.testing.assert_array_equal(late_commands[1:], commands[:-1])
    assert not late_commands[0].any()
    python = OnnxPolicy(folder)
    # Each episode begins with the safe command, not with one of the episode before.
    for episode in board_test(folder, episodes=2, link=Link(late=1.0)).on_board:
        assert not episode.action[0].any()
        np.testing.assert_allclose(
            episode.action[1:], python.predict(episode.observation[:-2])[0], atol=1e-5
        )


@of_furuta
def test_simulation_may_have_a_different_motor_than_the_loop(folder):
    real = DRIVE.replaced(
        {"motor.torque_constant": 0.03, "motor.back_emf_constant": 0.03, "motor.resistance": 9.0}
    )
    result = board_test(folder, episodes=1, actuator=real)
    assert result.on_board[0].actuator.motor == real.motor
    # The C converts the torque with the torque constant of the training. Python uses the real
    # motor's and needs more current, up to the drive's 2 A.
    board, python = (side[0].signals["current"][0] for side in (result.on_board, result.in_python))
    torque = abs(float(result.on_board[0].action[0, 0]))
    assert abs(board) == pytest.approx(torque / 0.042, rel=0.02)
    assert abs(python) == pytest.approx(min(torque / 0.03, 2.0), rel=0.02)
    with pytest.raises(ValueError, match="actuator: a Lag, must be a Drive"):
        board_test(folder, episodes=1, actuator={"family": "lag"})


def test_command_beyond_the_limits_is_the_safe_one(tmp_path):
    limits = {"arm_velocity": 4.0, "rod": 3.0}
    policy, _ = trained("furuta", "ppo")
    export(policy, FURUTA, "ppo", tmp_path / "out", 1, limits=limits)
    contract, python = Contract.read(tmp_path / "out"), OnnxPolicy(tmp_path / "out")
    assert contract.limits == {
        "arm_velocity": [-4.0, 4.0],
        "cos_rod": [pytest.approx(np.cos(3.0)), None],
    }
    assert "arm_velocity, at least -4, at most 4" in (tmp_path / "out/controller.h").read_text()
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, 200)
    rows = np.array(
        [[1.0, 0.0, np.cos(angle), np.sin(angle), 3.0 * angle, 0.0] for angle in angles]
    )
    is_safe = (np.abs(angles) < 3.0) & (np.abs(3.0 * angles) < 4.0)
    assert 20 < is_safe.sum() < 180
    np.testing.assert_array_equal(contract.is_within_limits(rows), is_safe)
    with Board(tmp_path / "out") as board:
        commands = np.array([board.command(row) for row in rows])
        assert board.beyond_limits == (~is_safe).sum()
    assert not commands[~is_safe].any()
    assert commands[is_safe].all()
    np.testing.assert_allclose(python.predict(rows)[0], commands, atol=1e-6)
    for name, limit, message in (
        ("arm_velocit", 4.0, "did you mean arm_velocity"),
        ("arm_velocity", -4.0, "arm_velocity = -4: must be > 0"),
        ("rod", 4.0, "must be > 0 and < pi"),
    ):
        with pytest.raises(ValueError, match=message):
            export(policy, FURUTA, "ppo", tmp_path / "other", 1, limits={name: limit})


@pytest.mark.skipif(
    bool(missing_tools("cortex-m4f")), reason=f"NOT RUN: {missing_tools('cortex-m4f')}"
)
def test_instructions_are_counted_on_the_emulated_board(folder):
    policy, sample = instructions(folder)
    products = 6 * 64 + 64 * 64 + 64
    # A Cortex-M4F has no hardware for double.
    assert 2 * products < policy < (20 if kind_of(folder) == "f" else 400) * products
    assert 10 < sample < 2000


@of_furuta
def test_lost_and_damaged_frames_give_the_safe_command(folder):
    result = board_test(folder, episodes=2, link=Link(lost=0.1, damaged=0.1), loop=False)
    assert result.refused > 0
    assert result.unanswered > 0
    # A flipped bit, whichever it is, never leads to a command of the policy.
    with Board(folder, link=Link(damaged=1.0)) as board:
        for row in Contract.read(folder).golden["observations"]:
            assert not board.command(np.array(row)).any()
        assert board.refused == board.frames


@of_cartpole
@pytest.mark.parametrize("noise", [b"\xa5", b"\xa5\x5a" + bytes(21), b"\x00\xa5\xa5"])
def test_answer_after_noise_is_found(folder, noise):
    contract = Contract.read(folder)
    numbers = np.full(
        len(contract.observations) + 4 * len(contract.actions),
        struct.unpack("<d", b"\xa5\x5a" * 4)[0],
    )
    (request_read, request_write), (answer_read, answer_write) = os.pipe(), os.pipe()
    wire = Wire(contract, request_write, answer_read)
    os.write(answer_write, noise)
    for sequence in range(1, 21):
        content = struct.pack(f"<BBI{len(numbers)}d", sequence, OK, 0, *numbers)
        os.write(
            answer_write,
            b"\xa5\x5a" + content + struct.pack("<H", binascii.crc_hqx(content, 0xFFFF)),
        )
        answer = wire.request(b"", sequence, 0.2)
        assert answer is not None
        assert (answer.sequence, answer.status) == (sequence, OK)
        np.testing.assert_array_equal(answer.observation, numbers[: len(contract.observations)])
    for descriptor in (request_read, request_write, answer_read, answer_write):
        os.close(descriptor)


def kind_of(folder):
    """Return the type of numbers of a folder's C, as a letter of `struct`."""
    return "d" if Contract.read(folder).task == "cartpole" else "f"


def form_of(folder):
    """Return the format of an answer: k observations and m commands have k + 4 m numbers."""
    contract = Contract.read(folder)
    return struct.Struct(
        f"<HBBI{len(contract.observations) + 4 * len(contract.actions)}{kind_of(folder)}H"
    )


def answers_to(folder, program, sent):
    """Return the program's answers to bytes: sequence, status, stamp and command of each."""
    form, contract = form_of(folder), Contract.read(folder)
    output = subprocess.run(
        [program], input=sent, capture_output=True, check=True, timeout=20
    ).stdout
    answers = []
    for offset in range(0, len(output), form.size):
        start, sequence, status, stamp, *numbers, check = form.unpack(
            output[offset : offset + form.size]
        )
        command = numbers[len(contract.observations) :][: len(contract.actions)]
        assert start == 0x5AA5
        assert check == binascii.crc_hqx(output[offset + 2 : offset + form.size - 2], 0xFFFF)
        answers.append((sequence, status, stamp, command))
    return answers


@pytest.fixture(scope="module")
def program(folder, tmp_path_factory):
    """Compile the controller for this machine with gcc's sanitizers."""
    path = str(tmp_path_factory.mktemp("sanitized") / "controller")
    sources = [str(folder / name) for name in ("controller.c", "wire.c", "board.c")]
    strict = [
        "-std=c99",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-Wconversion",
        "-Wpedantic",
        "-fsanitize=address,undefined",
    ]
    subprocess.run(["cc", *strict, *sources, "-lm", "-o", path], check=True)
    return path


def frame(folder, sequence, stamp, row, kind=0, spoilt=False):
    content = struct.pack(f"<BBI{len(row)}{kind_of(folder)}", sequence, kind, stamp % 2**32, *row)
    return b"\xa5\x5a" + content + struct.pack("<H", binascii.crc_hqx(content, 0xFFFF) ^ spoilt)


def test_status_tells_damaged_repeated_late_and_old_frames(folder, program):
    rows = Contract.read(folder).golden["observations"]
    # The 32-bit clock overflows within these frames.
    good = [frame(folder, n, 2**32 - 40_000 + 20_000 * n, rows[n]) for n in range(6)]
    expected = [command for *_, command in answers_to(folder, program, b"".join(good))]
    flipped = bytearray(good[1])
    flipped[11] ^= 4
    hours = frame(folder, 7, 3_600_000_000, rows[5])
    infinite = frame(folder, 8, 60_000, [np.inf, *rows[5][1:]])
    sent = [
        b"\xa5noise\xa5\x5a",
        good[0],
        bytes(flipped),
        good[1],
        good[1],
        good[0],
        good[4],
        infinite,
        hours,
    ]
    answers = answers_to(folder, program, b"".join(sent[1:]))
    safe = [0.0] * len(expected[0])
    assert [status for _, status, *_ in answers] == [
        OK,
        DAMAGED,
        OK,
        OLD,
        OLD,
        LATE,
        NOT_FINITE,
        OLD,
    ]
    assert [command for *_, command in answers] == [
        expected[0],
        safe,
        expected[1],
        expected[1],
        expected[1],
        expected[4],
        safe,
        safe,
    ]
    # Noise that begins like a frame does not hide the frames after it.
    after_noise = answers_to(folder, program, sent[0] + b"".join(good))
    assert [command for _, status, _, command in after_noise if status == OK] == expected


@of_furuta
@pytest.mark.parametrize("num_lost", [1, 9])
def test_frame_with_lost_bytes_is_refused_and_the_next_are_accepted(folder, program, num_lost):
    rows = Contract.read(folder).golden["observations"]
    good = [frame(folder, n, 20_000 * n + 1, rows[n]) for n in range(8)]
    expected = [command for *_, command in answers_to(folder, program, b"".join(good))]
    answers = answers_to(folder, program, good[0] + good[1][:-num_lost] + b"".join(good[2:]))
    accepted = {
        sequence: command for sequence, status, _, command in answers if status in (OK, LATE)
    }
    assert accepted == {n: expected[n] for n in (0, 2, 3, 4, 5, 6, 7)}


WATCHING, DRIVING = 1, 2


@pytest.fixture
def wired(folder, tmp_path):
    """Return functions of the exported wire that send a frame and call the watchdog; a contract.

    The first sends a frame of a kind at a stamp [us], the second takes a time [us]; both return a
    status and True if the drive has a command.
    """
    library = with_sensors(folder, tmp_path, "-shared", "-fPIC", "-DBAD=0", "-DWORSE=0", "-DGONE=0")
    wire, contract = ctypes.CDLL(library), Contract.read(folder)
    real = {"f": ctypes.c_float, "d": ctypes.c_double}[kind_of(folder)]
    applied = (real * len(contract.actions)).in_dll(wire, "given")
    state, answer = (ctypes.c_ubyte * 1024)(), (ctypes.c_ubyte * 256)()
    wire.wire_reset(state)

    def send(stamp, kind, spoilt=False):
        for byte in frame(folder, 1, stamp, contract.golden["observations"][0], kind, spoilt):
            wire.wire_byte(state, byte, answer)
        return answer[3], any(applied)

    return send, lambda time: (bool(wire.wire_late(state, time % 2**32)), any(applied)), contract


@of_furuta
def test_watchdog_uses_the_boards_clock_and_stops_the_drive(wired):
    send, late, contract = wired
    after = round(1e6 * contract.late["after"])
    # No frame has come yet.
    assert late(5_000_000) == (True, False)
    assert send(1_000, DRIVING) == (OK, True)
    # The frame's arrival counts, on the board's clock, which started before the host's.
    assert late(5_000_100) == (
        False,
        True,
    )
    assert late(5_000_100 + after) == (False, True)
    assert late(5_000_101 + after) == (True, False)
    # The host has started again, with stamps from zero, or hours have passed.
    assert send(1, DRIVING) == (
        OK,
        True,
    )
    assert late(2**32 - 10) == (False, True)
    # The clock has overflowed.
    assert late(after - 10) == (False, True)
    assert late(after - 9) == (True, False)


@of_cartpole
def test_old_frame_does_not_start_the_drive(wired):
    send, _, _ = wired
    assert send(9_000, WATCHING) == (OK, False)
    # The command of a watching frame was not given to the drive.
    assert send(9_000, DRIVING) == (OLD, False)
    assert send(10_000, DRIVING) == (OK, True)
    # A repeated frame leaves the drive's command.
    assert send(10_000, DRIVING) == (OLD, True)
    assert send(11_000, DRIVING, spoilt=True) == (DAMAGED, False)
    assert send(10_000, DRIVING) == (OLD, False)


def test_log_of_the_board_passes_the_check_and_a_changed_one_fails(folder, tmp_path, capsys):
    log = tmp_path / "log.csv"
    assert main(["board", "test", str(folder), "--episodes", "1", "--log", str(log)]) == 0
    assert "1 of 1" in capsys.readouterr().out
    assert main(["board", "check", str(folder), str(log)]) == 0
    contract = Contract.read(folder)
    result = check_log(folder, log)
    assert (result.late, result.differing) == (0, 0)
    assert result.rate == pytest.approx(contract.rate)
    header, *rows = [line.split(",") for line in log.read_text().splitlines()]
    command_column = 1 + len(contract.observations)
    assert header[command_column + 1 :] == [
        "motor_voltage:V",
        "motor_current:A",
        "motor_position:rad",
    ]
    refused = {
        "order": ([header[0], header[2], header[1], *header[3:]], rows),
        "rate": (header, [[str(2.0 * float(row[0])), *row[1:]] for row in rows]),
        "convert it": ([*header[:command_column], "motor:kg", *header[command_column + 1 :]], rows),
        "increase": (header, [rows[1], rows[0], *rows[2:]]),
        "cells": (header, [rows[0][:-1], *rows[1:]]),
        "a number": (header, [["soon", *rows[0][1:]], *rows[1:]]),
        "no column 'motor'": (header[:command_column], [row[:command_column] for row in rows]),
    }

    def text(header, rows, end="\n"):
        return end.join(",".join(row) for row in (header, *rows))

    for message, table in refused.items():
        log.write_text(text(*table))
        with pytest.raises(ValueError, match=message):
            check_log(folder, log)
    # A spreadsheet program saves the file in this way.
    log.write_text("\ufeff" + text(header, rows, "\r\n") + "\r\n\r\n", encoding="utf-8")
    assert check_log(folder, log) == result
    for row in rows:
        row[command_column] = str(float(row[command_column]) + 0.01)
    log.write_text(text(header, rows))
    assert check_log(folder, log).differing == len(rows)
    assert main(["board", "check", str(folder), str(log)]) == 1


@of_furuta
def test_ended_program_is_an_error(folder, tmp_path, capsys):
    for line, message in {
        "wire_reset(&wire);\n": "the board's program ended at frame 1",
        "current_state state;\n": "the board's current loop did not answer at sample",
    }.items():
        insert_text(folder, tmp_path, line, "  if (sizeof(real) > 0) return 3;\n", "board.c")
        assert main(["board", "test", str(tmp_path), "--episodes", "1"]) == 2
        assert message in capsys.readouterr().err


@of_cartpole
def test_bad_input_and_missing_tools_are_errors(folder, tmp_path, monkeypatch, capsys):
    for line, message in {
        (
            "test",
            str(folder),
            "--lost",
            "1.5",
        ): "Link.lost = 1.5: must be a finite number >= 0 and <= 1",
        (
            "test",
            str(folder),
            "--no-loop",
            "--pwm-bits",
            "8",
        ): "the simulation closes the current loop: leave",
        ("test", str(folder), "--target", "avr"): "avr",
        ("test", str(tmp_path)): "contract.json",
    }.items():
        assert main(["board", *line]) == 2
        assert message in capsys.readouterr().err
    (folder / "board.c").rename(folder / "elsewhere.c")
    assert main(["board", "test", str(folder)]) == 2
    assert "board.c: missing: write the folder with codrl-mj export" in capsys.readouterr().err
    (folder / "elsewhere.c").rename(folder / "board.c")
    monkeypatch.setenv("PATH", "")
    assert main(["board", "test", str(folder), "--target", "cortex-m4f"]) == 2
    assert (
        "apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"
        in capsys.readouterr().err
    )


@of_furuta
@pytest.mark.parametrize("weight", ["0.0f / 0.0f + ", "1.5f + "])
def test_wrong_weight_fails_the_golden_check_and_fast_math_does_not_compile(
    folder, tmp_path, weight
):
    program = tmp_path / "golden"
    controller = insert_text(folder, tmp_path, "bias_0[64] = {", weight) / "controller.c"
    sources = [str(controller), str(folder / "main.c")]
    subprocess.run(
        ["cc", "-std=c99", f"-I{folder}", *sources, "-lm", "-o", str(program)], check=True
    )
    assert subprocess.run([program], check=False, capture_output=True).returncode == 1
    for flag in ("-ffast-math", "-ffinite-math-only"):
        refused = subprocess.run(
            ["cc", flag, "-c", f"-I{folder}", sources[1], "-o", str(program)], capture_output=True
        )
        assert b"without -ffast-math" in refused.stderr
