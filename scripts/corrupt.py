"""Corrupt the inputs of codrl-mj at random, and check how each command ends.

There are three kinds of cases, drawn from a seed: run folders (bytes changed, files cut, deleted,
emptied or exchanged, JSON entries edited), files that a user writes (motors, actuators, tasks,
families, configurations, models, bench logs), and command lines (words dropped, doubled,
exchanged, misspelled, out of bounds). Each case runs in its own process, forked from one that has
compiled the shared code. A case passes if the exit status is 0, 1 or 2, a refusal is a sentence,
there is no traceback and no signal, no half-written file remains, and no file that the command does
not name as its output is changed or deleted. A command that still runs after `--patience` receives
Ctrl-C, and must end with status 130 and a message.
"""

import argparse
import collections
import contextlib
import dataclasses
import gc
import hashlib
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.progress import track
from rich.table import Table

from codrl_mj.cli import main as codrl_mj
from codrl_mj.cli.terminal import console
from codrl_mj.runs.files import temporary_files, with_digest

SOME = (1, 1, 1, 2, 3)
"""Number of changes in a case, drawn from these with equal probability."""
MEMORY = 8_000_000_000
"""Limit of a case's memory [bytes]."""
GRACE = 30.0
"""Time [s] that a case has to end after Ctrl-C."""
WILD = (
    "-1",
    "0",
    "1e99",
    "nan",
    "inf",
    "-inf",
    "1e400",
    "1e-300",
    "10000000000",
    "abc",
    "''",
    "",
    "None",
    "[]",
    "{}",
    "ü",
)
"""Values that are written in place of others."""

MOTOR = """\
manufacturer = "mine"
product = "30:1 motor"
kind = "brushed, geared"
[datasheet]
shaft = "output"
gear_ratio = "30:1"
nominal_voltage = "12 V"
stall_torque = "14 kgf*cm"
stall_current = "5.5 A"
no_load_speed = "330 rpm"
no_load_current = "0.2 A"
inductance = "1.3 mH"
rotor_inertia = "10.5 gcm2 at motor"
max_winding_temperature = "155 degC"
[sources]
"shop" = "the rest"
"""
ACTUATOR = """\
family: drive
motor: {resistance: 1.03, inductance: 0.572e-3, torque_constant: 0.0335, back_emf_constant: 0.0335, gear_ratio: 20}
controller: {sample_rate: 20000.0, max_current: 10.0, delayed: true}
supply: {voltage: 24.0}
"""
PATTERNS = """\
slide.*:
  family: lag
  time_constant: 0.02
"""
CONFIGURATION = """\
task: cartpole
agent: {name: ppo, gamma: 0.98, rollout_steps: 32, batch_size: 32}
env:
  actuator: {motor: {inductance: 0.2}, controller: {kp: 2.0}}
  randomize: {motor.resistance: "uniform(0.8, 1.2)"}
  disturbances: {command_delay: 0.02}
total_steps: 256
evaluation_episodes: 1
"""
MODEL = """\
<mujoco model="wheel">
  <option timestep="0.002" integrator="RK4"><flag constraint="disable"/></option>
  <worldbody>
    <body name="rod">
      <joint name="pivot" type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 0.12" mass="0.15" diaginertia="3e-4 3e-4 1e-5"/>
      <body name="wheel" pos="0 0 0.2">
        <joint name="spin" type="hinge" axis="0 1 0"/>
        <inertial pos="0 0 0" mass="0.12" diaginertia="1.2e-4 2.4e-4 1.2e-4"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="spin"/></actuator>
</mujoco>
"""
TASK = """\
from pathlib import Path
import numpy as np
import codrl_mj

def initial_bounds(options):
    return np.array([-0.08, 0.0, 0.0, 0.0]), np.array([0.08, 0.0, 0.0, 0.0])

def initial_state(draws):
    return draws[0], draws[1], draws[2], draws[3]

def observation(state):
    return 5.0 * state[0], 0.5 * state[2], 0.01 * state[3]

def reward(state, force, next_state, options):
    return 1.0 - 4.0 * next_state[0] * next_state[0] - 2e-6 * next_state[3] * next_state[3]

def terminated(state):
    return np.abs(state[0]) > 0.5

def constrain(state, timestep):
    return state[0], state[1], state[2], min(max(state[3], -900.0), 900.0)

TASK = codrl_mj.register(codrl_mj.Task(
    name="wheel", env_id="mine/Wheel-v0", asset=str(Path(__file__).with_name("wheel.xml")),
    actuator="quanser-qube-servo-3", max_force=0.09, step_duration=0.02, motor_inner_steps=10, ideal_inner_steps=10,
    max_episode_steps=300, integrators=("rk4",),
    state_names=("rod [rad]", "wheel [rad]", "rod_dot [rad/s]", "wheel_dot [rad/s]"),
    observation_names=("rod", "rod_dot", "wheel_dot"), constrain=constrain,
    initial_bounds=initial_bounds, initial_state=initial_state, observation=observation, reward=reward,
    terminated=terminated))
"""
FAMILY = """\
import dataclasses
from typing import ClassVar, NamedTuple
from codrl_mj.actuators import ActuatorModel
from codrl_mj.fields import real

class State(NamedTuple):
    torque: float

class Signals(NamedTuple):
    lost: float

def advance(parameters, timestep, state, inputs):
    wanted = parameters.efficiency * inputs.desired_torque
    torque = state.torque + (wanted - state.torque) * min(timestep / parameters.time_constant, 1.0)
    return State(torque), torque, Signals(inputs.desired_torque - torque)

@dataclasses.dataclass(frozen=True)
class Gearbox(ActuatorModel):
    family: ClassVar[str] = "gearbox"
    State: ClassVar[type] = State
    Signals: ClassVar[type] = Signals
    advance: ClassVar = staticmethod(advance)
    efficiency: float = real(0.8, above=0, maximum=1)
    time_constant: float = real(0.05, above=0)
"""

_SHORT = "--total-steps 256 --evaluation-episodes 1 --no-tensorboard"
_PPO = f"--agent ppo --agent.rollout-steps 32 --agent.batch-size 32 {_SHORT}"
RUNS = {
    "weaker": f"train cartpole --actuator weaker {_PPO} --checkpoint-interval 100",
    "ideal": f"train cartpole --actuator ideal {_PPO}",
    "ddpg": f"train pendulum --agent ddpg {_SHORT}",
    "foreign": f"train InvertedPendulum-v5 --actuators slide=lag {_PPO}",
}
"""Name -> command line of a run folder; `unfinished` is `weaker` without its last files."""
COLUMNS = "--columns time=time:s,voltage=mean(voltage):V,current=current:A,position=position:rad"
SIMULATE = (
    "identify simulate maxon-ec45-flat-50w --kind prbs --amplitude 4 --duration 1 --mean-voltage"
)

ON_RUNS = (
    "runs .",
    "runs --compare RUN runs/ideal",
    "evaluate RUN --episodes 1",
    "evaluate RUN --episodes 1 --which best",
    "evaluate RUN --episodes 1 --actuator paper",
    "train --resume RUN",
    "report RUN --no-film --out page.html",
    "replay RUN --out film.html",
    "motor feasible maxon-ec45-flat-50w RUN",
    "motor choose RUN --top 2",
)
"""Commands for a corrupted run folder, RUN."""
ON_FILES = {
    "motor.toml": (
        "motor show motor.toml",
        "motor design motor.toml",
        "motor feasible motor.toml pendulum",
        f"train pendulum --actuator motor.toml {_PPO}",
        "advise motor.toml pendulum",
    ),
    "actuator.yaml": (
        "motor show actuator.yaml",
        "motor step actuator.yaml",
        f"train pendulum --actuator actuator.yaml {_PPO}",
        "evaluate runs/ideal --episodes 1 --actuator actuator.yaml",
        "advise actuator.yaml cartpole",
    ),
    "patterns.yaml": (f"train InvertedPendulum-v5 --actuators patterns.yaml {_PPO}",),
    "config.yaml": ("train --config config.yaml --no-tensorboard --out runs/configured",),
    "wheel.py": (f"train wheel.py:TASK {_PPO}",),
    "wheel.xml": (f"train wheel.py:TASK {_PPO}",),
    "gearbox.py": (f"train cartpole --actuator gearbox.py:Gearbox {_PPO}",),
    "log.csv": (f"identify check log.csv {COLUMNS}", "identify columns log.csv"),
}
"""File -> commands for it when it is corrupted."""
COMMANDS = (
    *(
        command.replace("RUN", "runs/unfinished" if "resume" in command else "runs/ideal")
        for command in ON_RUNS
    ),
    *(command for commands in ON_FILES.values() for command in commands),
    f"train cartpole --actuator weaker --env.center-radius 0.1 --seed 3 --out runs/mine {_PPO}",
    f"train pendulum --actuator maxon-ec45-flat-50w --actuator.motor.gear-ratio 20 {_PPO}",
    (
        "train cartpole --env.randomize motor.inductance=uniform(0.05,0.2)"
        f" controller.kp=loguniform(0.5,5) {_PPO}"
    ),
    (
        "train InvertedPendulum-v5 --actuators slide=maxon-ec45-flat-50w --env.options"
        f" frame_skip=2 {_PPO}"
    ),
    "evaluate runs/foreign --episodes 1 --actuators slide=lag --out evaluation.json",
    (
        "evaluate runs/weaker --episodes 2 --seed 4 --actuator paper --actuator.motor.inductance"
        " 0.3 --stochastic"
    ),
    "render runs/weaker --out film.mp4 --actuator paper",
    "view runs/weaker --port 8123",
    "runs runs --sort return --out runs.json",
    "motor list --sort stall_torque",
    "motor show maxon-ec45-flat-50w --voltage 12 --json",
    "motor design quanser-qube-servo-2 --bandwidth 1500 --delayed --out loop",
    "motor step maxon-ec45-flat-50w --sample-rate 20000 --json",
    "motor feasible maxon-ec45-flat-50w pendulum --gear-ratio 20 --voltage 12 --out feasible",
    "motor choose pendulum --top 3 --margin 0.1 --out chosen",
    "motor new mine.toml",
    "advise maxon-ec45-flat-50w pendulum --gear-ratio 20 --json",
    "identify plan maxon-ec45-flat-50w --inertia 1e-4 --duration 1",
    f"{SIMULATE} --inertia 1e-4 --seed 2 --out other.csv",
    f"identify check log.csv {COLUMNS} --json",
    f"identify log.csv {COLUMNS} --rig free --known load_inertia=0 gear_ratio=1 --out found",
    "validate pendulum --quick --out certificate",
    "--version",
)
"""Short command lines, as a user types them."""


@dataclasses.dataclass(frozen=True)
class Case:
    """Command with its own folder, in which `corrupt` has changed something."""

    kind: str
    command: list[str]
    corrupted: str
    """Description of the change."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Result of a case."""

    status: int
    """Exit status; negative for a signal."""
    interrupted: bool
    output: str
    lost: list[str]
    """Files that were changed or deleted, and half-written files that remained."""

    @property
    def failures(self) -> list[str]:
        """Descriptions of everything that is wrong with the result."""
        allowed = (130,) if self.interrupted else (0, 1, 2)
        has_message = "codrl-mj: " in self.output
        problems = [] if self.status in allowed else [f"exit status {self.status}"]
        if "Traceback (most recent call last)" in self.output:
            problems.append("traceback")
        if self.status in (2, 130) and not has_message:
            problems.append("no message")
        return problems + [f"lost: {name}" for name in self.lost]


def change_bytes(content: bytes, rng: random.Random) -> bytes:
    """Return bytes with one to four changed, cut at a random length, or empty."""
    if rng.random() < 0.25 or not content:
        return content[: rng.randrange(len(content) + 1) if rng.random() < 0.8 else 0]
    changed = bytearray(content)
    for _ in range(rng.randint(1, 4)):
        changed[rng.randrange(len(changed))] ^= (
            1 << rng.randrange(3) if rng.random() < 0.7 else rng.randrange(1, 256)
        )
    return bytes(changed)


def change_entry(content: Any, rng: random.Random) -> Any:
    """Return a nested JSON value with one entry deleted, added or replaced."""
    if isinstance(content, dict | list) and content and rng.random() < 0.85:
        keys = list(content) if isinstance(content, dict) else list(range(len(content)))
        key = rng.choice(keys)
        if rng.random() < 0.15:
            return (
                {k: v for k, v in content.items() if k != key}
                if isinstance(content, dict)
                else content[:key]
            )
        changed = content.copy()
        changed[key] = change_entry(content[key], rng)
        return changed
    if isinstance(content, dict) and rng.random() < 0.5:
        return content | {rng.choice(("surplus", "name", "family", "x" * 300)): 1}
    return rng.choice(
        (
            None,
            -1,
            0,
            1e300,
            float("nan"),
            float("inf"),
            "x",
            "",
            [],
            {},
            [[]],
            True,
            10**30,
            "paper",
        )
    )


def change_text(text: str, rng: random.Random) -> str:
    """Return a text in which some words or lines are deleted, doubled, exchanged or misspelled."""
    for _ in range(rng.choice(SOME)):
        words = list(re.finditer(r"[\w.]+|[^\w\s]", text)) or list(re.finditer("", text))
        word, other_word = rng.choice(words), rng.choice(words)
        new = rng.choice(
            (
                lambda: "",
                lambda: word[0] * 2,  # noqa: B023 - called immediately
                lambda: other_word[0],  # noqa: B023
                lambda: misspell(word[0], rng),  # noqa: B023
                lambda: scale(word[0], rng),  # noqa: B023
                lambda: scale(word[0], rng),  # noqa: B023
                lambda: rng.choice(WILD),
            )
        )()
        text = text[: word.start()] + new + text[word.end() :]
        if rng.random() < 0.2:
            lines = text.splitlines(keepends=True) or [""]
            row = rng.randrange(len(lines))
            lines[row : row + 1] = rng.choice(
                ([], [lines[row]] * 2, [rng.choice(lines)], ["\t" + lines[row]])
            )
            text = "".join(lines)
    return text


def misspell(word: str, rng: random.Random) -> str:
    """Return a word with a letter deleted, doubled, replaced, or swapped with its neighbor."""
    index = rng.randrange(max(len(word), 1))
    head, letter, tail = word[:index], word[index : index + 1], word[index + 1 :]
    return rng.choice(
        (
            head + tail,
            head + 2 * letter + tail,
            head + tail[:1] + letter + tail[1:],
            head + "q" + tail,
        )
    )


def scale(word: str, rng: random.Random) -> str:
    """Multiply a number by a random factor; cut the last letter of any other word."""
    try:
        return f"{float(word) * rng.choice((-1.0, 0.0, 1e-6, 0.1, 10.0, 1e3, 1e6)):g}"
    except ValueError:
        return word[:-1]


def corrupt_run(folder: Path, rng: random.Random) -> Case:
    """Corrupt one file of a run folder."""
    run = folder / "runs" / rng.choice([*RUNS, "unfinished"])
    path = rng.choice(sorted(path for path in run.rglob("*") if path.is_file()))
    change = rng.choice(
        ("bytes", "bytes", "lost", "exchanged", "folder", "entry", "entry", "entry with a seal")
    )
    # Only JSON files have entries.
    if change.startswith("entry") and path.suffix != ".json":
        change = "bytes"
    exchanged = folder / "runs" / rng.choice(list(RUNS)) / path.relative_to(run)
    if change == "bytes":
        path.write_bytes(change_bytes(path.read_bytes(), rng))
    elif change.startswith("entry"):
        content = json.loads(path.read_text())
        content.pop("sha256", None)
        content = change_entry(content, rng)
        # With a valid seal the file is accepted, so that the checks of its entries are reached.
        is_sealed = change != "entry" and isinstance(content, dict)
        path.write_text(json.dumps(with_digest(content) if is_sealed else content))
    elif change == "exchanged" and exchanged.is_file():
        path.write_bytes(exchanged.read_bytes())
    else:
        path.unlink()
        if change == "folder":
            path.mkdir()
    command = rng.choice(ON_RUNS).replace("RUN", str(run.relative_to(folder)))
    return Case("run folders", command.split(), f"{path.relative_to(folder)}: {change}")


def corrupt_file(folder: Path, rng: random.Random) -> Case:
    """Corrupt a file that a user writes."""
    name = rng.choice(list(ON_FILES))
    path = folder / name
    if rng.random() < 0.15:
        path.write_bytes(change_bytes(path.read_bytes(), rng))
    else:
        path.write_text(change_text(path.read_text(), rng))
    return Case("files", rng.choice(ON_FILES[name]).split(), name)


def corrupt_command(folder: Path, rng: random.Random) -> Case:  # noqa: ARG001 - same signature
    """Corrupt a command line."""
    words = rng.choice(COMMANDS).split()
    for _ in range(rng.choice(SOME)):
        index, other_index = rng.randrange(len(words)), rng.randrange(len(words))
        change = rng.choice(("drop", "double", "swap", "misspell", "scale", "scale", "wild"))
        if change == "drop" and len(words) > 1:
            del words[index]
        elif change == "double":
            words.insert(index, words[index])
        elif change == "swap":
            words[index], words[other_index] = words[other_index], words[index]
        elif change == "misspell":
            words[index] = misspell(words[index], rng)
        elif change == "scale":
            # Numbers are scaled if there are any.
            index = rng.choice(
                [position for position, word in enumerate(words) if word[:1].isdigit()] or [index]
            )
            words[index] = scale(words[index], rng)
        else:
            words[index] = rng.choice((*WILD, "/dev/null/x", "runs", "wheel.py", "log.csv"))
    return Case("command lines", words, "")


KINDS: dict[str, Callable[[Path, random.Random], Case]] = {
    "runs": corrupt_run,
    "files": corrupt_file,
    "commands": corrupt_command,
}
"""Kind, as `--only` takes it -> function that corrupts a folder."""


def prepare(folder: Path) -> None:
    """Create the run folders and files; this compiles the code that the cases share."""
    texts = {
        "motor.toml": MOTOR,
        "actuator.yaml": ACTUATOR,
        "patterns.yaml": PATTERNS,
        "config.yaml": CONFIGURATION,
        "wheel.py": TASK,
        "wheel.xml": MODEL,
        "gearbox.py": FAMILY,
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    commands = [f"{command} --out runs/{name}" for name, command in RUNS.items()]
    commands += [
        f"{SIMULATE} --out log.csv",
        f"train pendulum --actuator actuator.yaml {_PPO} --out ../warm",
    ]
    commands += ["report runs/weaker --no-film --out ../warm.html", "advise actuator.yaml pendulum"]
    with contextlib.chdir(folder):
        for command in commands:
            assert codrl_mj(command.split()) == 0, command
    # An unfinished training lacks the files that are written at its end.
    shutil.copytree(folder / "runs" / "weaker", folder / "runs" / "unfinished")
    for name in (
        "result.json",
        "evaluation.json",
        "policy.json",
        "policy.safetensors",
        "learning_curve.png",
    ):
        (folder / "runs" / "unfinished" / name).unlink()
    # Garbage is collected before the forks, so that children do not copy its memory pages.
    gc.collect()


def digests(folder: Path) -> dict[str, str]:
    """Return the digest of every file in a folder, by its path."""
    # Locks may be created or left by any command.
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in paths
    }


def attempt(case: Case, folder: Path, patience: float) -> Outcome:
    """Run a case in its own process and return its result."""
    before, output = digests(folder), folder.with_suffix(".output")
    child = os.fork()
    if child == 0:
        _run_child(case.command, folder, output)
    end, interrupted, ended = time.monotonic() + patience, False, (0, 0)
    while ended[0] == 0:
        if time.monotonic() > end:
            # Like a terminal, send the signal to the whole process group.
            os.killpg(child, signal.SIGKILL if interrupted else signal.SIGINT)
            end, interrupted = time.monotonic() + GRACE, True
        time.sleep(0.01)
        ended = os.waitpid(child, os.WNOHANG)
    # Kill the processes that the command may have started and left.
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    status = os.waitstatus_to_exitcode(ended[1])
    after = digests(folder)
    # A resumed training writes into its folder, and into its tables immediately.
    resumed = "--resume" in case.command
    lost = [
        name
        for name in before
        if after.get(name) != before[name]
        and name not in " ".join(case.command)
        and not (resumed and (status == 0 or name.endswith(".csv")))
    ]
    halves = [
        str(path.relative_to(folder))
        for parent in [folder, *folder.rglob("*")]
        for path, _ in temporary_files(parent)
    ]
    return Outcome(status, interrupted, output.read_text(errors="replace"), lost + halves)


def _run_child(command: list[str], folder: Path, output: Path) -> None:
    """Run a command in the forked child and exit with its status."""
    status = 99
    try:
        os.setsid()
        os.chdir(folder)
        # The limit turns a huge allocation into a MemoryError, which the command has to report.
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
        for target, flags in ((0, os.O_RDONLY), (1, os.O_WRONLY), (2, os.O_WRONLY)):
            path = "/dev/null" if target == 0 else output
            os.dup2(os.open(path, flags | (os.O_CREAT | os.O_APPEND if target else 0)), target)
        sys.stdout, sys.stderr = (os.fdopen(target, "w", buffering=1) for target in (1, 2))
        sys.argv = ["codrl-mj", *command]
        status = codrl_mj(command)
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else int(error.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def control(base: Path, patience: float) -> None:
    """Run every command line unchanged; if one failed, its corruption would prove nothing."""
    for command in track(COMMANDS, "as they are", console=console(), transient=True):
        shutil.copytree(base, base.with_name("control"))
        outcome = attempt(Case("", command.split(), ""), base.with_name("control"), patience)
        assert outcome.status in (0, 1, 130), (command, outcome)
        shutil.rmtree(base.with_name("control"))
        base.with_name("control.output").unlink()


def cases(
    count: int, seed: int, only: list[str], base: Path, patience: float
) -> Iterator[tuple[str, Case, Outcome]]:
    """Run `count` cases of each kind; yield their names, which reproduce them, and results."""
    names = [f"{kind}/{seed}/{index}" for kind in only for index in range(count)]
    for name in track(names, "corrupting", console=console(), transient=True):
        folder = base.parent / "case"
        shutil.copytree(base, folder)
        case = KINDS[name.split("/")[0]](folder, random.Random(name))
        yield name, case, attempt(case, folder, patience)
        shutil.rmtree(folder)
        folder.with_suffix(".output").unlink()


def main() -> int:
    """Run the cases, and print a table of results and all failures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=300, help="cases of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=list(KINDS), nargs="+", default=list(KINDS))
    parser.add_argument("--patience", type=float, default=60.0, help="time before Ctrl-C [s]")
    parser.add_argument("--log", type=Path, help="file for all cases with their outputs")
    options = parser.parse_args()
    counts: collections.Counter[tuple[str, str]] = collections.Counter()
    failed = 0
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        log = stack.enter_context(options.log.open("w")) if options.log else None
        base = Path(folder) / "base"
        base.mkdir()
        prepare(base)
        control(base, options.patience / 4)
        for name, case, outcome in cases(
            options.count, options.seed, options.only, base, options.patience
        ):
            ending = "Ctrl-C" if outcome.interrupted else f"status {outcome.status}"
            counts[case.kind, ending] += 1
            text = f"{name}: codrl-mj {' '.join(case.command)} [{case.corrupted}] -> {ending}"
            if log is not None:
                print(text, outcome.failures, outcome.output, sep="\n", flush=True, file=log)
            if outcome.failures:
                failed += 1
                console().print(
                    escape(f"{text}: {', '.join(outcome.failures)}\n{outcome.output[-1500:]}"),
                    style="red",
                )
    table = Table(title="How they ended", title_justify="left")
    for column in ("corrupted", "how", "cases"):
        table.add_column(column)
    for (kind, ending), number in sorted(counts.items()):
        table.add_row(kind, ending, str(number))
    console().print(table)
    console().print(f"{failed} of {sum(counts.values())} failed")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
