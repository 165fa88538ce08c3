"""Kill trainings at random moments, resume them, and compare them with uninterrupted ones.

Every training runs `codrl-mj train` as a program. It is ended by SIGTERM, SIGINT or `kill -9` and
resumed by `codrl-mj train --resume`. The moment is drawn between the start and the end of the
uninterrupted training, in processor time, which other programs do not change. The exit status is 1
if anything differs from docs/training.md: exit status and message, lost steps, files left behind,
and the result, bit for bit.
"""

import argparse
import csv
import dataclasses
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.table import Table

from codrl_mj.cli.terminal import console
from codrl_mj.runs.files import read_json

PROGRAM = Path(sys.executable).with_name("codrl-mj")
INTERVAL = 1000
"""Number of environment steps between two checkpoints."""
_OFTEN = f"--checkpoint-interval {INTERVAL} --evaluation-interval 5000 --evaluation-episodes 3"
TRAININGS = {
    "ppo": (
        "cartpole --actuator weaker --agent ppo --agent.rollout-steps 512 --total-steps 30000"
        f" {_OFTEN}"
    ),
    "dqn": f"cartpole --agent dqn --total-steps 6000 {_OFTEN}",
    "sarsa": f"mountain_car --agent sarsa --total-episodes 80 --env.physics analytic {_OFTEN}",
}
"""Agent -> command line of about ten seconds.

SARSA's episodes are stepped in Python with Gymnasium's equations.
"""
ROLLOUT = {"ppo": 512, "dqn": 1, "sarsa": 200}
"""Maximum number of environment steps between the ends of two rollouts."""
TIME_COLUMNS = ("steps_per_second", "seconds")
"""Columns of progress.csv that differ from run to run."""
STATUS = {signal.SIGTERM: 143, signal.SIGINT: 130, signal.SIGKILL: -9}


def outcome(run: Path) -> dict[str, Any]:
    """Return a run's results that must not depend on interruptions, by file name."""
    files = ["policy.safetensors", "policy.json", "evaluation.json", "episodes.csv"]
    files += [f"best/{name}" for name in ("policy.safetensors", "policy.json", "evaluation.json")]
    with (run / "progress.csv").open() as file:
        progress = [
            {name: row[name] for name in row if name not in TIME_COLUMNS}
            for row in csv.DictReader(file)
        ]
    result = read_json(run / "result.json", "result of a run")
    result.pop("seconds")
    return {name: (run / name).read_bytes() for name in files} | {
        "progress.csv": progress,
        "result.json": result,
    }


def differing(first: dict[str, Any], second: dict[str, Any]) -> list[str]:
    """Return the names of the results that differ."""
    return [name for name in first if first[name] != second[name]]


def saved_steps(run: Path) -> int:
    """Return the environment steps of the last checkpoint; 0 if there is none."""
    names = (re.match(r"step-(\d+)-", path.name) for path in (run / "checkpoints").glob("step-*"))
    return max((int(match[1]) for match in names if match), default=0)


def reported_steps(run: Path) -> int:
    """Return the environment steps of the last report; 0 if there is none."""
    path = run / "progress.csv"
    rows = path.read_text().splitlines(keepends=True)[1:] if path.exists() else []
    # A row without a line feed was cut off by the kill.
    return max((int(row.partition(",")[0]) for row in rows if row.endswith("\n")), default=0)


def hidden_files(run: Path) -> list[str]:
    """Return the names of the hidden files in a run folder, except its lock."""
    return [path.name for path in run.rglob(".*") if path.name != ".lock"]


@dataclasses.dataclass(frozen=True)
class Kill:
    """Training that was killed and resumed."""

    agent: str
    """Name of the agent."""
    signal: str
    """Name of the signal."""
    moment: float
    """Moment of the kill [s of processor time]."""
    status: int
    """Exit status of the killed program."""
    reported: int
    """Last reported environment steps."""
    saved: int
    """Environment steps of its last checkpoint."""
    left: int
    """Number of hidden files that it left."""
    problems: tuple[str, ...]
    """Differences from the documented behavior."""


def start(arguments: str, folder: Path) -> subprocess.Popen[str]:
    """Start `codrl-mj train` in a folder."""
    line = [str(PROGRAM), "train", *arguments.split()]
    return subprocess.Popen(
        line, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


def seconds_used(pid: int) -> float:
    """Return the processor time of a child process [s]."""
    # A program's name may contain spaces and parentheses, so the fields start after the last one.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def kill(
    agent: str, number: signal.Signals, moment: float, expected: dict[str, Any], folder: Path
) -> Kill:
    """Kill a training and resume it.

    Args:
        agent: one of `TRAININGS`.
        number: signal to send.
        moment: moment of the kill [s of processor time].
        expected: results of the uninterrupted training.
        folder: empty folder for the run.
    """
    run, problems = folder / "run", []
    training = start(f"{TRAININGS[agent]} --out run", folder)
    while training.poll() is None and seconds_used(training.pid) < moment:
        time.sleep(0.005)
    training.send_signal(number)
    _, error = training.communicate()
    status = training.returncode
    reported = reported_steps(run)
    saved = saved_steps(run)
    num_hidden = len(hidden_files(run))
    has_started, has_finished = (run / "config.json").exists(), (run / "result.json").exists()
    # Before Python has installed its handlers a signal ends the process with its number.
    if (
        status != STATUS[number]
        and not (has_finished and status == 0)
        and (has_started or status != -number)
    ):
        problems.append(f"exit status {status}")
    if (
        has_started
        and not has_finished
        and number != signal.SIGKILL
        and "train --resume run" not in error
    ):
        problems.append(f"message {error!r}")
    # An interrupted import may end with a traceback; a training must not.
    if number != signal.SIGKILL and "Traceback" in error and has_started:
        problems.append("traceback")
    # A checkpoint is only written at the end of a rollout.
    if reported - saved > INTERVAL + ROLLOUT[agent]:
        problems.append(f"{reported - saved} steps lost")
    resumed = start("--resume run" if has_started else f"{TRAININGS[agent]} --out run", folder)
    _, error = resumed.communicate()
    if resumed.returncode or error:
        problems.append(f"continued: status {resumed.returncode}: {error}")
    else:
        problems += [f"{name} differs" for name in differing(expected, outcome(run))]
        problems += [f"{name} is left" for name in hidden_files(run)]
    return Kill(agent, number.name, moment, status, reported, saved, num_hidden, tuple(problems))


def main() -> int:
    """Kill and resume as often as requested, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0, help="seed of the moments")
    arguments = parser.parse_args()
    moments = random.Random(arguments.seed)
    table = Table(
        "agent", "signal", "at [CPU s]", "status", "reported", "saved", "files left", "same result"
    )
    kills = []
    with tempfile.TemporaryDirectory() as root:
        expected, seconds = {}, {}
        for agent, line in TRAININGS.items():
            before = os.times()
            _, error = start(f"{line} --out {agent}", Path(root)).communicate()
            after = os.times()
            seconds[agent] = (
                after.children_user
                - before.children_user
                + after.children_system
                - before.children_system
            )
            if error:
                raise RuntimeError(f"the uninterrupted training of {agent} failed: {error}")
            expected[agent] = outcome(Path(root) / agent)
        for index in range(arguments.kills):
            agent = list(TRAININGS)[index % len(TRAININGS)]
            number = moments.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
            folder = Path(root) / str(index)
            folder.mkdir()
            result = kill(
                agent, number, moments.uniform(0, seconds[agent]), expected[agent], folder
            )
            kills.append(result)
            row = [
                result.agent,
                result.signal,
                f"{result.moment:.2f}",
                result.status,
                result.reported,
                result.saved,
                result.left,
            ]
            table.add_row(*map(str, row), "; ".join(result.problems) or "yes")
    console().print(table)
    bad = sum(bool(result.problems) for result in kills)
    print(
        f"{len(kills) - bad} of {len(kills)} trainings came to the uninterrupted result, bit"
        " for bit"
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
