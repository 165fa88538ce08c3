"""Trainings in separate processes that are killed and continued."""

import gc
import os
import random
import signal
import sys
import time
from pathlib import Path

import pytest

from codrl_mj.cli import main
from codrl_mj.runs import files, policies
from codrl_mj.training import checkpoint, folder, history, run, watcher
from tests.matrix import matrix_params
from tests.training.interruptions import differing, kill_test, outcome

INTERVAL = 500
LINE = (
    f"cartpole --actuator weaker --num-envs 4 --total-steps 2500 --checkpoint-interval {INTERVAL}"
    " --agent ppo"
)
LINE += (
    " --agent.rollout-steps 256 --agent.batch-size 64 --agent.epochs 2 --agent.hidden 8"
    " --no-tensorboard"
)
LINE += " --evaluation-interval 1000 --evaluation-episodes 2"
ROLLOUT = 256


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    out = tmp_path_factory.mktemp("uninterrupted") / "run"
    assert main(["train", *LINE.split(), "--out", str(out)]) == 0
    return outcome(out)


def in_a_process(arguments, prepare=lambda: None):
    """Start the command line in a fork of this process, with all imports and compiled code.

    Returns:
        The process's id. Its output goes to the file `output`.
    """
    gc.collect()
    child = os.fork()
    if child == 0:
        status = 99
        # The deletion of an old simulation would wait for its threads, which a fork does not have.
        gc.freeze()
        try:
            # The process ends in any case.
            signal.alarm(60)
            output = os.open("output", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(output, 1)
            os.dup2(output, 2)
            sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False) for number in (1, 2))
            prepare()
            status = main(arguments)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    return child


def status_of(child):
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def continued(expected):
    """Continue the run, and compare it with the uninterrupted one."""
    assert main(["train", "--resume", "run"]) == 0
    assert differing(expected, outcome(Path("run"))) == []
    assert kill_test.hidden_files(Path("run")) == []


STATUS = {"SIGKILL": -9, "SIGTERM": 143, "SIGINT": 130}


@pytest.mark.parametrize("number", matrix_params(["SIGKILL"], STATUS))
def test_a_training_killed_at_a_random_moment_gives_the_same_result(expected, number):
    moment = random.Random(number)
    steps, wait = moment.randint(1, 1000), moment.uniform(0.0, 0.05)
    child = in_a_process(["train", *LINE.split(), "--out", "run"])
    while kill_test.saved_steps(Path("run")) < steps:
        # The process is alive.
        assert os.waitpid(child, os.WNOHANG) == (0, 0)
        time.sleep(0.005)
    time.sleep(wait)
    os.kill(child, signal.Signals[number])
    assert status_of(child) == STATUS[number]
    assert not Path("run/result.json").exists()
    lost = kill_test.reported_steps(Path("run")) - kill_test.saved_steps(Path("run"))
    assert lost <= (INTERVAL + ROLLOUT if number == "SIGKILL" else 0)
    if number != "SIGKILL":
        message = Path("output").read_text().splitlines()[-1]
        assert message.startswith(
            f"codrl-mj: stopped after {kill_test.saved_steps(Path('run')):,} steps: continue with "
        )
        assert message.endswith("codrl-mj train --resume run")
    continued(expected)


def die_at_call(owner, name, which):
    """Kill the process at a function's n-th call, or at one with matching arguments."""
    original, calls = getattr(owner, name), iter(range(1, 10**9))

    def dying(*arguments, **keywords):
        if which(*arguments) if callable(which) else next(calls) == which:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(*arguments, **keywords)

    setattr(owner, name, dying)


KILLED_WHILE = {
    "taking the folder": lambda: die_at_call(run, "write_json", 1),
    "writing the configuration": lambda: die_at_call(files.json, "dumps", 3),
    "beginning the tables": lambda: die_at_call(history.csv, "writer", 2),
    "writing a checkpoint": lambda: die_at_call(checkpoint.os, "fsync", 3),
    "deleting an old checkpoint": lambda: die_at_call(Path, "unlink", 2),
    "exchanging the best policy's files": lambda: die_at_call(policies, "write_json", 2),
    "writing the best policy": lambda: die_at_call(watcher, "write_json", 1),
    "marking the run as finished": lambda: die_at_call(
        watcher, "write_json", lambda path, _: path.name == folder.RESULT
    ),
}


@pytest.mark.parametrize("moment", matrix_params(["writing a checkpoint"], KILLED_WHILE))
def test_a_training_killed_while_writing_gives_the_same_result(expected, moment):
    line = ["train", *LINE.split(), "--out", "run"]
    assert status_of(in_a_process(line, KILLED_WHILE[moment])) == -9
    if Path("run/config.json").exists():
        continued(expected)
    else:
        # No training had started.
        assert main(["train", "--resume", "run"]) == 2
