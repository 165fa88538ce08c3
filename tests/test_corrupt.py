"""Corrupted input: a command refuses it with a message and damages no file."""

import importlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "corrupt.py"


@pytest.fixture(scope="module")
def corrupt():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPT.parent))
        yield importlib.import_module("corrupt")


@pytest.mark.matrix
def test_thirty_cases_of_each_kind_pass(tmp_path):
    command = [sys.executable, str(SCRIPT), "--count", "30", "--log", str(tmp_path / "log")]
    completed = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    assert completed.returncode == 0, completed.stdout + completed.stderr
    assert "0 of 90 failed" in completed.stdout


def _ends(status, message=""):
    def program():
        print(message, end="", file=sys.stderr)
        return status

    return program


def _crashes():
    raise KeyError("x")


def _ends_by_a_signal():
    os.kill(os.getpid(), signal.SIGKILL)


def _does(change):
    """Return a program that changes a file and succeeds."""
    # `change` may return anything; the program's exit status is 0.
    return lambda: 0 * bool(change())


def _dies_of_ctrl_c():
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    time.sleep(60)


def _ends_at_ctrl_c():
    try:
        time.sleep(60)
    except KeyboardInterrupt:
        print("codrl-mj: stopped", file=sys.stderr)
        return 130


@pytest.mark.parametrize(
    ("program", "failures"),
    [
        (_ends(0), []),
        (_ends(2, "codrl-mj: error: there is no such thing\n"), []),
        (_ends_at_ctrl_c, []),
        (_ends(2), ["no message"]),
        (_crashes, ["exit status 99", "traceback"]),
        (_ends_by_a_signal, ["exit status -9"]),
        (_does(lambda: Path("mine").write_text("theirs")), ["lost: mine"]),
        (_does(lambda: Path("mine").unlink()), ["lost: mine"]),
        (_does(lambda: Path(".out-abcd1234.html").touch()), ["lost: .out-abcd1234.html"]),
        (_dies_of_ctrl_c, ["exit status -2"]),
    ],
)
def test_each_kind_of_failure_is_detected(corrupt, tmp_path, monkeypatch, program, failures):
    folder = tmp_path / "case"
    folder.mkdir()
    (folder / "mine").write_text("mine")
    monkeypatch.setattr(corrupt, "codrl_mj", lambda _: program())
    outcome = corrupt.attempt(corrupt.Case("files", ["runs"], ""), folder, patience=0.5)
    assert outcome.failures == failures, outcome


def test_a_case_only_depends_on_its_name(corrupt):
    texts = [
        corrupt.change_text(corrupt.MOTOR, random.Random(f"files/{seed}"))
        for seed in (0, 0, *range(1, 20))
    ]
    assert texts[0] == texts[1]
    assert len(set(texts)) > 15
