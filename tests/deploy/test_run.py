"""A board at a serial port: here a program of the exported C, with sensors of its own, behind a pseudo-terminal."""

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
    """The board's program of an exported folder, compiled with these sensors; its path."""
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


def exported(out, fastest):
    export(
        trained("furuta", "ppo")[0],
        EnvConfig("furuta"),
        "ppo",
        out,
        1,
        limits={"arm_velocity": fastest},
    )
    return out


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return exported(tmp_path_factory.mktemp("exported") / "furuta", 20.0)


@pytest.fixture
def port(folder, tmp_path):
    """Starts a board, and says where it is; BAD is the question to which an arm's velocity of WORSE is the answer."""
    tty, running, opened = pytest.importorskip("tty"), [], []

    def start(bad=0, worse="0", gone=0):
        program = with_sensors(
            folder, tmp_path, f"-DBAD={bad}", f"-DWORSE={worse}", f"-DGONE={gone}"
        )
        ours, theirs = os.openpty()
        tty.setraw(theirs)
        tty.setraw(ours)
        opened.extend((ours, theirs))
        running.append(subprocess.Popen([program], stdin=ours, stdout=ours))
        return os.ttyname(theirs)

    yield start
    for one in running:
        one.kill()
        one.wait()
    for one in opened:
        os.close(one)


def table_of(log):
    header, *rows = [line.split(",") for line in log.read_text().splitlines()]
    return header, np.array(rows, float)


@pytest.mark.parametrize("drive", [False, True])
def test_a_board_is_watched_or_driven_and_what_it_says_is_a_log(
    folder, port, tmp_path, drive, capsys
):
    log = tmp_path / "swing.csv"
    line = ["board", "run", str(folder), "--port", port(), "--out", str(log), "--seconds", "0.7"]
    assert main([*line, "--drive"] if drive else line) == 0
    assert "requested" in capsys.readouterr().out
    header, rows = table_of(log)
    assert 15 <= len(rows) <= 37  # 50 a second, fewer on a machine that is busy
    assert header[-4:] == ["motor:N*m", "motor_voltage:V", "motor_current:A", "motor_position:rad"]
    question = np.rint(
        rows[:, 2] / 0.01
    )  # of which one may stay without an answer, on such a machine
    np.testing.assert_allclose(rows[:, 2], 0.01 * question, rtol=1e-6)
    follows = np.diff(question, prepend=0.0) == 1.0
    assert (np.diff(question) >= 1.0).all()
    assert follows.sum() >= 10
    expected, _ = OnnxPolicy(folder).predict(rows[:, 1:7])
    np.testing.assert_allclose(rows[:, 7], expected[:, 0], atol=1e-6)
    given = (
        np.append(0.0, rows[:-1, 7]) if drive else np.zeros(len(rows))
    )  # what the drive got before
    np.testing.assert_allclose(rows[follows, 8], given[follows], atol=1e-6)
    found = check_log(folder, log)
    assert (found.rows, found.differing) == (len(rows), 0)
    columns = "time='time:s':s,voltage='motor_voltage:V':V,current='motor_current:A':A,"
    read = read_log(log, f"{columns}position='motor_position:rad':rad")
    np.testing.assert_allclose(read.signals["position"], 0.1 * question, rtol=1e-6)


@pytest.mark.parametrize(
    ("worse", "why"),
    [
        ("25", "beyond the limits"),
        ("-25", "beyond the limits"),
        ("(real)(1e30 * 1e30)", "no finite"),
    ],
)
def test_a_board_that_drives_is_stopped_when_something_is_wrong(folder, port, tmp_path, worse, why):
    done = run_board(folder, port(10, worse), tmp_path / "log.csv", drive=True, seconds=5.0)
    assert why in done.reason
    assert done.rows == 10 - done.missed  # on a machine that is busy an answer may come too late
    _, rows = table_of(tmp_path / "log.csv")
    assert rows[:-1, 7].all()
    assert rows[-1, 7] == 0.0  # in C
    watched = run_board(folder, port(10, worse), tmp_path / "log.csv", seconds=0.5)
    assert watched.reason == "requested"


def test_a_second_run_does_not_drive_with_the_command_of_the_first(folder, port, tmp_path):
    board = port()
    assert run_board(folder, board, tmp_path / "first.csv", seconds=0.5).reason == "requested"
    again = run_board(
        folder, board, tmp_path / "again.csv", drive=True, seconds=5.0
    )  # no watchdog: stamps are old
    assert "took a frame for old" in again.reason
    _, rows = table_of(tmp_path / "again.csv")
    assert not rows[:, 8].any()  # what the drive got


def test_what_was_logged_is_kept_when_it_is_interrupted(folder, port, tmp_path):
    answers = []

    def pull(answer):
        answers.append(answer)
        if len(answers) == 8:
            raise OSError("the cable is out")

    done = run_board(folder, port(), tmp_path / "log.csv", drive=True, seconds=5.0, on_answer=pull)
    assert "the cable is out" in done.reason
    assert len(table_of(tmp_path / "log.csv")[1]) == done.rows == 8


def test_a_number_that_is_none_is_named_with_its_line(folder, port, tmp_path):
    log = tmp_path / "log.csv"
    run_board(folder, port(10, "(real)(1e30 * 1e30)"), log, seconds=0.5)
    place = next(
        number for number, line in enumerate(log.read_text().splitlines(), 1) if "inf" in line
    )
    assert 10 <= place <= 11
    with pytest.raises(
        ValueError, match=rf"line {place}, arm_velocity:rad/s: inf: must be a finite number"
    ):
        check_log(folder, log)


def test_any_key_ends_it(folder, port, tmp_path):
    keys, terminal = os.openpty()
    line = [sys.executable, "-m", "codrl_mj", "board", "run", str(folder), "--port", port()]
    line += ["--out", str(tmp_path / "log.csv")]
    with subprocess.Popen(line, stdin=terminal, stdout=subprocess.PIPE) as running:
        assert b"any key ends it" in running.stdout.readline()
        time.sleep(1.0)
        os.write(keys, b" ")
        assert b"requested" in running.communicate(timeout=10)[0]
    assert running.returncode == 0
    for one in (keys, terminal):
        os.close(one)


def test_in_python_too_limits_are_kept(folder, port, tmp_path):
    tighter = exported(tmp_path / "tighter", 0.05)
    done = run_board(
        tighter, port(), tmp_path / "log.csv", drive=True, seconds=5.0
    )  # whose C allows 20 rad/s
    assert "beyond the limits" in done.reason
    _, rows = table_of(tmp_path / "log.csv")
    assert len(rows) == 6 - done.missed
    assert rows[-1, 7] != 0.0


def test_a_board_without_sensors_an_answer_or_a_port_is_said(folder, port, tmp_path, capsys):
    log = tmp_path / "log.csv"
    with pytest.raises(RuntimeError, match="the board has no sensors: give it wire_sense"):
        run_board(folder, port(gone=3), log, seconds=2.0)
    assert not log.exists()
    assert (
        main(["board", "run", str(folder), "--port", str(tmp_path / "nothing"), "--out", str(log)])
        == 2
    )
    assert "is the board plugged in" in capsys.readouterr().err
    ours, theirs = os.openpty()  # nobody listens
    done = run_board(folder, os.ttyname(theirs), log, drive=True, seconds=5.0)
    assert done.reason == "3 frames in a row had no answer"
    assert (done.rows, done.missed) == (0, 3)
    for one in (ours, theirs):
        os.close(one)
