"""Tests of a board at a serial port: a program of the exported C behind a pseudo-terminal."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from codrl_mj.cli import main
from codrl_mj.deploy import OnnxPolicy, check_log, export, run_board
from codrl_mj.deploy.board import missing_tools
from codrl_mj.envs.config import EnvConfig
from codrl_mj.identify.reading import read_log
from tests.deploy.test_export import trained

pytestmark = pytest.mark.skipif(
    bool(missing_tools("host")), reason="NOT RUN: no C compiler: apt-get install gcc"
)
SENSORS = """
#include "wire.h"
static int asked;
real given[CONTROLLER_COMMANDS];
int wire_sense(real observation[CONTROLLER_OBSERVATIONS]) {
  asked++;
  for (int k = 0; k < CONTROLLER_OBSERVATIONS; k++) observation[k] = 0.01f * (real)asked;
  observation[0] = observation[2] = 1;
  if (asked == BAD) observation[CONTROLLER_OBSERVATIONS - 2] = WORSE;
  return asked != GONE;
}
void wire_measure(real motors[3 * CONTROLLER_COMMANDS]) {
  motors[0] = given[0];
  motors[1] = 0.5f;
  motors[2] = 0.1f * (real)asked;
}
void wire_apply(const real command[CONTROLLER_COMMANDS]) { given[0] = command[0]; }
"""


def with_sensors(folder, out, *flags):
    """Compile the board's program of an exported folder with simulated sensors; return its path."""
    (out / "sensors.c").write_text(SENSORS)
    sources = [str(folder / name) for name in ("controller.c", "wire.c", "board.c")]
    line = [
        "cc",
        "-std=c99",
        "-DBOARD_SENSORS",
        *flags,
        f"-I{folder}",
        *sources,
        str(out / "sensors.c"),
    ]
    subprocess.run([*line, "-lm", "-o", str(out / "board")], check=True)
    return str(out / "board")


def exported(out, max_velocity):
    export(
        trained("furuta", "ppo")[0],
        EnvConfig("furuta"),
        "ppo",
        out,
        1,
        limits={"arm_velocity": max_velocity},
    )
    return out


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return exported(tmp_path_factory.mktemp("exported") / "furuta", 20.0)


@pytest.fixture
def port(folder, tmp_path):
    """Return a function that starts a board and returns its port.

    The board's measurement number `bad` has the arm velocity `worse`, and number `gone` fails.
    """
    tty, running, opened = pytest.importorskip("tty"), [], []

    def start(bad=0, worse="0", gone=0):
        program = with_sensors(
            folder, tmp_path, f"-DBAD={bad}", f"-DWORSE={worse}", f"-DGONE={gone}"
        )
        board_end, host_end = os.openpty()
        tty.setraw(host_end)
        tty.setraw(board_end)
        opened.extend((board_end, host_end))
        running.append(subprocess.Popen([program], stdin=board_end, stdout=board_end))
        return os.ttyname(host_end)

    yield start
    for process in running:
        process.kill()
        process.wait()
    for descriptor in opened:
        os.close(descriptor)


def table_of(log):
    header, *rows = [line.split(",") for line in log.read_text().splitlines()]
    return header, np.array(rows, float)


@pytest.mark.parametrize("drive", [False, True])
def test_answers_of_a_board_are_logged_while_watching_or_driving(
    folder, port, tmp_path, drive, capsys
):
    log = tmp_path / "swing.csv"
    line = ["board", "run", str(folder), "--port", port(), "--out", str(log), "--seconds", "0.7"]
    assert main([*line, "--drive"] if drive else line) == 0
    assert "requested" in capsys.readouterr().out
    header, rows = table_of(log)
    # There are 50 rows per second, and fewer on a busy machine.
    assert 15 <= len(rows) <= 37
    assert header[-4:] == ["motor:N*m", "motor_voltage:V", "motor_current:A", "motor_position:rad"]
    # On a busy machine a measurement may have no answer.
    measurement = np.rint(rows[:, 2] / 0.01)
    np.testing.assert_allclose(rows[:, 2], 0.01 * measurement, rtol=1e-6)
    follows = np.diff(measurement, prepend=0.0) == 1.0
    assert (np.diff(measurement) >= 1.0).all()
    assert follows.sum() >= 10
    expected, _ = OnnxPolicy(folder).predict(rows[:, 1:7])
    np.testing.assert_allclose(rows[:, 7], expected[:, 0], atol=1e-6)
    # The simulated sensors measure the command that the drive got before.
    applied = np.append(0.0, rows[:-1, 7]) if drive else np.zeros(len(rows))
    np.testing.assert_allclose(rows[follows, 8], applied[follows], atol=1e-6)
    result = check_log(folder, log)
    assert (result.rows, result.differing) == (len(rows), 0)
    columns = "time='time:s':s,voltage='motor_voltage:V':V,current='motor_current:A':A,"
    signal_log = read_log(log, f"{columns}position='motor_position:rad':rad")
    np.testing.assert_allclose(signal_log.signals["position"], 0.1 * measurement, rtol=1e-6)


@pytest.mark.parametrize(
    ("worse", "reason"),
    [
        ("25", "beyond the limits"),
        ("-25", "beyond the limits"),
        ("(real)(1e30 * 1e30)", "is not finite"),
    ],
)
def test_driving_board_is_stopped_if_something_is_wrong(folder, port, tmp_path, worse, reason):
    result = run_board(folder, port(10, worse), tmp_path / "log.csv", drive=True, seconds=5.0)
    assert reason in result.reason
    # On a busy machine an answer may come too late.
    assert result.rows == 10 - result.missed
    _, rows = table_of(tmp_path / "log.csv")
    assert rows[:-1, 7].all()
    # The C itself gives the safe command.
    assert rows[-1, 7] == 0.0
    watched = run_board(folder, port(10, worse), tmp_path / "log.csv", seconds=0.5)
    assert watched.reason == "requested"


def test_second_run_does_not_drive_with_the_command_of_the_first(folder, port, tmp_path):
    board = port()
    assert run_board(folder, board, tmp_path / "first.csv", seconds=0.5).reason == "requested"
    # Without a watchdog, the board takes the second run's stamps for old.
    second = run_board(folder, board, tmp_path / "again.csv", drive=True, seconds=5.0)
    assert "refused a frame as old" in second.reason
    _, rows = table_of(tmp_path / "again.csv")
    # This column has the commands that the drive got.
    assert not rows[:, 8].any()


def test_interrupted_run_keeps_its_log(folder, port, tmp_path):
    answers = []

    def pull(answer):
        answers.append(answer)
        if len(answers) == 8:
            raise OSError("the cable is out")

    result = run_board(
        folder, port(), tmp_path / "log.csv", drive=True, seconds=5.0, on_answer=pull
    )
    assert "the cable is out" in result.reason
    assert len(table_of(tmp_path / "log.csv")[1]) == result.rows == 8


def test_raises_for_a_value_that_is_not_finite_with_its_line(folder, port, tmp_path):
    log = tmp_path / "log.csv"
    run_board(folder, port(10, "(real)(1e30 * 1e30)"), log, seconds=0.5)
    line_number = next(
        number for number, line in enumerate(log.read_text().splitlines(), 1) if "inf" in line
    )
    assert 10 <= line_number <= 11
    with pytest.raises(
        ValueError, match=rf"line {line_number}, arm_velocity:rad/s: inf: must be a finite number"
    ):
        check_log(folder, log)


def test_any_key_ends_the_run(folder, port, tmp_path):
    keys, terminal = os.openpty()
    line = [sys.executable, "-m", "codrl_mj", "board", "run", str(folder), "--port", port()]
    line += ["--out", str(tmp_path / "log.csv")]
    with subprocess.Popen(line, stdin=terminal, stdout=subprocess.PIPE) as running:
        assert b"any key ends it" in running.stdout.readline()
        time.sleep(1.0)
        os.write(keys, b" ")
        assert b"requested" in running.communicate(timeout=10)[0]
    assert running.returncode == 0
    for descriptor in (keys, terminal):
        os.close(descriptor)


def test_limits_are_also_checked_in_python(folder, port, tmp_path):
    tighter = exported(tmp_path / "tighter", 0.05)
    # The board's C allows 20 rad/s.
    result = run_board(tighter, port(), tmp_path / "log.csv", drive=True, seconds=5.0)
    assert "beyond the limits" in result.reason
    _, rows = table_of(tmp_path / "log.csv")
    assert len(rows) == 6 - result.missed
    assert rows[-1, 7] != 0.0


def test_missing_sensors_answers_and_ports_are_reported(folder, port, tmp_path, capsys):
    log = tmp_path / "log.csv"
    with pytest.raises(RuntimeError, match="the board has no sensors: give it wire_sense"):
        run_board(folder, port(gone=3), log, seconds=2.0)
    assert not log.exists()
    assert (
        main(["board", "run", str(folder), "--port", str(tmp_path / "nothing"), "--out", str(log)])
        == 2
    )
    assert "is the board plugged in" in capsys.readouterr().err
    # No program reads from this terminal.
    board_end, host_end = os.openpty()
    result = run_board(folder, os.ttyname(host_end), log, drive=True, seconds=5.0)
    assert result.reason == "3 frames in a row had no answer"
    assert (result.rows, result.missed) == (0, 3)
    for descriptor in (board_end, host_end):
        os.close(descriptor)
