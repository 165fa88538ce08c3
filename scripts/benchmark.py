"""Speed of our environments beside others'; everything is measured side by side in this one run.

The members of a group take turns: A, B, C, A, B, C, ... with many steps a turn; the table has the
median of the ratios to the group's first member, turn by turn, with their range. Libraries that are
not installed are skipped.

`--publish` puts them into docs/results/speed.csv, in place of the same groups' before, and writes
docs/speed.md. `--quick` compares with scripts/ratios.json instead, in two minutes, and fails where
something became slower; a change that is meant to be slower says why, and writes them anew by
`--keep`. Trainings are in scripts/benchmark_training.py.
"""

# isort: skip - before mujoco, which chooses its OpenGL platform when it is imported
import argparse
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from rich.table import Table

import benchmark_subjects as subjects
import codrl_mj
from benchmark_subjects import Subject
from codrl_mj.cli.terminal import console
from codrl_mj.physics.sharing import num_cpus
from codrl_mj.runs.files import read_json, write_json
from codrl_mj.study import markdown_table, read_csv, write_csv, write_page
from codrl_mj.tasks import OURS

Makers = list[Callable[[], Subject]]
NUM_ENVS = 1024
BOUGHT = "maxon-ec45-flat-50w"
# of its dm_control swing-ups Pendulum's alone: a thousand of the others take minutes to make
ENVPOOL = {
    "pendulum": ("Pendulum-v1", "PendulumSwingup-v1"),
    "cartpole": ("CartPole-v1",),
    "acrobot": ("Acrobot-v1",),
    "mountain_car": ("MountainCar-v0",),
    "mountain_car_continuous": ("MountainCarContinuous-v0",),
}
TASKS = {task.name: task for task in OURS}
APART = (
    "mountain_car",
    "mountain_car_continuous",
)  # whose walls need a call of the engine for each step of it
RATIOS = Path(__file__).with_name("ratios.json")
"""Group -> member -> its ratio to the group's first member, as it was."""
ROWS = Path(__file__).parents[1] / "docs" / "results" / "speed.csv"
PAGE, WRITTEN = ROWS.parents[1] / "speed.md", "<!-- written by scripts/benchmark.py -->\n"
SHOWN = {
    "single: pendulum": "One Pendulum",
    "single: cartpole": "One CartPole",
    "two threads: pendulum": "1024 Pendulums, two threads",
    "two threads: cartpole": "1024 CartPoles, two threads",
    "EnvPool: 1024": "1024 Pendulums beside EnvPool's, two threads",
    "EnvPool: 16384": "16,384 of them",
    "foreign: HalfCheetah-v5": "HalfCheetah, six motors",
    "foreign: Humanoid-v5": "Humanoid, seventeen motors",
    "engine: pendulum": "The engine's step, Pendulum",
}
"""Group -> what it is called on the page."""
SLOWER = 0.85
"""Of a ratio that is kept, below which something became slower."""
TRIES = 4
"""Measurements of a group, by whose best it is judged: other processes make something slower, none makes it faster."""
DM_CONTROL = {"pendulum": "swingup", "cartpole": "swingup", "acrobot": "swingup"}


def kept_groups() -> dict[str, Makers]:
    """What `--quick` compares: the single step, the batch, the engine and an environment of others."""
    found: dict[str, Makers] = {
        "single: pendulum": [
            partial(subjects.theirs, "Pendulum-v1"),
            partial(subjects.ours, "pendulum", "paper"),
        ],
        "single: cartpole": [
            partial(subjects.theirs, "InvertedPendulum-v5"),
            partial(subjects.ours, "cartpole", "paper"),
        ],
        "foreign: HalfCheetah-v5": [
            partial(subjects.without_motors, "HalfCheetah-v5", BOUGHT),
            partial(subjects.foreign, "HalfCheetah-v5", BOUGHT),
        ],
        "engine: pendulum": [
            partial(subjects.engine, "pendulum", one) for one in (None, "paper", "drive")
        ],
    }
    for task in ("pendulum", "cartpole", "acrobot"):
        found[f"two threads: {task}"] = [
            subject(task, NUM_ENVS, 2) for subject in (_batch, _vector)
        ]
    return found


def _batch(task: str, num_envs: int, threads: int) -> Callable[[], Subject]:
    return partial(subjects.raw_batch, task, num_envs, threads, task in APART)


def _vector(task: str, num_envs: int, threads: int) -> Callable[[], Subject]:
    return partial(subjects.vector, task, num_envs, threads)


def compare(keep: bool) -> int:
    """Measure what is kept; 1 where something became slower, by the best of some tries.

    Args:
        keep: write the ratios, each the least of the tries, instead of comparing.
    """
    kept: dict[str, Any] = {} if keep else read_json(RATIOS, "ratios")
    slower = False
    for title, makers in kept_groups().items():
        first, *others = members = build(makers)
        was = np.array([0.0 if keep else kept[title][one.name] for one in others])
        clock = (
            time.perf_counter if "threads" in title else time.process_time
        )  # which other processes do not move
        tries: list[list[float]] = []
        while len(tries) < TRIES and (
            keep or not tries or (np.max(tries, axis=0) < SLOWER * was).any()
        ):
            found = measure(members, 15, 0.02, clock)
            tries.append([found[one.name]["ratio"][0] for one in others])
        if keep:
            kept[title] = {
                one.name: round(ratio, 3)
                for one, ratio in zip(others, np.min(tries, axis=0), strict=True)
            }
        for one, ratio, before in zip(others, np.max(tries, axis=0), was, strict=True):
            verdict = "  SLOWER" if ratio < SLOWER * before else ""
            print(
                f"{title}: {one.name}: {ratio:.3f} of {first.name}, was {before:.3f}{verdict}",
                flush=True,
            )
            slower |= bool(verdict)
    if keep:
        write_json(RATIOS, kept)
    return int(slower)


def groups() -> dict[str, Makers]:
    """What is compared with what; the first of a group is what the others are divided by."""
    found: dict[str, Makers] = {}
    for task in TASKS:
        found[f"engine: {task}"] = [
            partial(subjects.engine, task, one) for one in (None, "paper", "drive", "stepped")
        ]
    for count in (1, 6, 17):
        drivers = (None, "ideal", "torque_speed", "lag", "current_loop")
        found[f"motorised: {count} motors"] = [
            partial(subjects.chain, count, driver) for driver in drivers
        ]
    for env_id in ("HalfCheetah-v5", "Humanoid-v5"):
        given = (None, "ideal", "lag", "torque_speed", BOUGHT)
        found[f"foreign: {env_id}"] = [
            partial(subjects.foreign, env_id, driver) for driver in given
        ]
        found[f"foreign: {env_id}"].append(partial(subjects.without_motors, env_id, BOUGHT))
    for task, definition in TASKS.items():
        assert definition.gymnasium_id is not None
        members: Makers = [partial(subjects.theirs, definition.gymnasium_id)]
        members += [partial(subjects.ours, task, actuator) for actuator in ("paper", "ideal")]
        if task == "cartpole":
            members.append(partial(subjects.theirs, "InvertedPendulum-v5"))
        if task in DM_CONTROL:
            members.append(partial(subjects.dm_control, task, DM_CONTROL[task]))
        if task == "pendulum":
            members.append(subjects.electric_motor)
        found[f"single: {task}"] = members
    for task in TASKS:
        members = [partial(subjects.raw_batch, task, NUM_ENVS, 1, apart) for apart in (False, True)]
        members += [
            partial(subjects.vector, task, NUM_ENVS, 1, actuator) for actuator in ("paper", "ideal")
        ]
        members += [partial(subjects.envpool, name, NUM_ENVS, 1) for name in ENVPOOL[task]]
        found[f"vector: {task}"] = members
        apart = task in APART
        members = [
            partial(subjects.raw_batch, task, NUM_ENVS, 2, apart),
            partial(subjects.vector, task, NUM_ENVS, 2),
        ]
        found[f"two threads: {task}"] = members
    for count in (NUM_ENVS, 16_384):
        both = (
            partial(subjects.envpool, "Pendulum-v1", count, 2),
            partial(subjects.vector, "pendulum", count, 2),
        )
        found[f"EnvPool: {count}"] = list(both)
    cores = sorted({1, 2, num_cpus()})
    sizes = [
        (num_envs, threads) for num_envs in (NUM_ENVS, 1, 64, 16_384, 100_000) for threads in cores
    ]
    for task in TASKS:
        found[f"sizes: {task}"] = [partial(subjects.vector, task, *size) for size in sizes]
    for task in ("cartpole", "mountain_car"):
        found[f"drawing: {task}"] = [
            partial(subjects.drawing, task, fast) for fast in (False, True)
        ]
    return found


def build(makers: Makers) -> list[Subject]:
    """The members of a group that can be had here; the others are named, with the reason."""
    members = []
    for make in makers:
        try:
            members.append(make())
        except (
            Exception
        ) as error:  # a missing library, or one that does not work with the others installed
            arguments = ", ".join(map(str, getattr(make, "args", ())))
            name = getattr(make, "func", make).__name__
            console().print(
                f"skipped: {name} {arguments}: {type(error).__name__}: {error}", markup=False
            )
    return members


def seconds(member: Subject, calls: int, clock: Callable[[], float]) -> float:
    """The time that some calls take."""
    member.prepare()
    start = clock()
    member.run(calls)
    return clock() - start


def measure(
    members: list[Subject],
    turns: int,
    turn_duration: float,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, dict[str, list[float]]]:
    """Time the members in turn.

    Returns:
        By name: steps per second, and their ratio to the first member's: (median, least, most)
        each.
    """
    calls = []
    for member in members:
        seconds(member, 1, clock)  # compiles what it needs
        count = 1
        while (taken := seconds(member, count, clock)) < turn_duration / 4 and count < 1_000_000:
            count *= 4
        calls.append(max(1, round(count * turn_duration / taken)))
    speeds = np.empty((turns, len(members)))
    for turn in range(turns):
        for column, member in enumerate(members):
            speeds[turn, column] = (
                calls[column] * member.per_call / seconds(member, calls[column], clock)
            )
    ratios = speeds / speeds[:, :1]
    return {
        member.name: {
            "steps_per_second": _spread(speeds[:, column]),
            "ratio": _spread(ratios[:, column]),
        }
        for column, member in enumerate(members)
    }


def _spread(values: np.ndarray) -> list[float]:
    return [float(np.median(values)), float(values.min()), float(values.max())]


def memory() -> dict[str, float]:
    """Resident memory of a Pendulum environment with its motor in a batch [bytes], from the growth at N = 16384."""
    page, num_envs = os.sysconf("SC_PAGE_SIZE"), 16384

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * page

    before = resident()
    env = gymnasium.make_vec(TASKS["pendulum"].env_id, num_envs, "vector_entry_point")
    env.reset(seed=0)
    env.step(np.zeros((num_envs, 1), np.float32))
    return {"bytes_per_environment": (resident() - before) / num_envs}


def learning() -> dict[str, dict[str, float]]:
    """PPO's environment steps per second, and the share of the time that stepping takes."""
    found = {}
    for num_envs, ours in ((8, False), (64, True), (256, True)):
        name, train = subjects.ppo(num_envs, ours)
        train(2048)  # warm-up
        steps = 20480
        start = time.perf_counter()
        share = train(steps)
        found[name] = {
            "steps_per_second": steps / (time.perf_counter() - start),
            "share_in_environment": share,
        }
    return found


def families() -> dict[str, float]:
    """Seconds until a family runs in the engine, the first one's and the others'; they are compiled once a process."""
    code = (
        "import time, codrl_mj\nfrom codrl_mj.actuators import FAMILIES\nfor name, family in"
        " FAMILIES.items():\n"
    )
    code += (
        "    if name != 'ideal':\n        start = time.perf_counter()\n       "
        " codrl_mj.engine.load_family(family)\n"
    )
    code += "        print(name, time.perf_counter() - start)"
    lines = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    return dict(zip(lines[::2], map(float, lines[1::2]), strict=True))


def report(title: str, results: dict[str, dict[str, list[float]]]) -> None:
    """Print a group's table."""
    table = Table(title=title, title_justify="left")
    for column in ("", "steps/s", "ratio to the first"):
        table.add_column(column, justify="right" if column else "left")
    for name, numbers in results.items():
        ratio = "{:.2f} ({:.2f} to {:.2f})".format(*numbers["ratio"])
        table.add_row(name, f"{numbers['steps_per_second'][0]:,.0f}", ratio)
    console().print(table)


def publish(
    results: dict[str, dict[str, dict[str, list[float]]]], file: Path = ROWS, page: Path = PAGE
) -> None:
    """Put groups among the rows of a file, and what is shown of all of them on a page."""
    rows = [row for row in read_csv(file) if row["group"] not in results]
    for group, members in results.items():
        for name, numbers in members.items():
            speed, ratio = (
                numbers["steps_per_second"][0],
                [f"{one:.3f}" for one in numbers["ratio"]],
            )
            row = {"group": group, "member": name, "steps_a_second": f"{speed:.0f}"}
            rows.append(row | dict(zip(("ratio", "least", "most"), ratio, strict=True)))
    write_csv(file, rows)
    tables = []
    for group, title in SHOWN.items():
        own = [row for row in rows if row["group"] == group]
        told = [
            (row["member"], f"{int(row['steps_a_second']):,}", f"{float(row['ratio']):.2f}")
            for row in own
        ]
        tables.append(
            markdown_table((title, "steps a second", "times the first"), told, 2) if told else ""
        )
    write_page(page, [page.read_text().partition(WRITTEN)[0] + WRITTEN, *tables])


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="compare with the ratios that are kept: two minutes"
    )
    parser.add_argument("--keep", action="store_true", help="measure and write those")
    parser.add_argument(
        "--only", default="", help="only groups whose name contains this, such as 'vector'"
    )
    parser.add_argument("--turns", type=int, default=11, help="turns of each member of a group")
    parser.add_argument("--duration", type=float, default=0.1, help="of a turn [s]")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    parser.add_argument(
        "--publish", action="store_true", help="put the groups' rows and their page into docs/"
    )
    options = parser.parse_args()
    turns = options.turns
    if turns < 1:
        parser.error(f"--turns {turns}: must be >= 1")
    gymnasium.logger.min_level = gymnasium.logger.ERROR
    if options.quick or options.keep:
        return compare(options.keep)
    results: dict[str, Any] = {}
    measured: dict[str, Any] = {}
    if options.only in "memory":
        results["memory"] = memory()  # first: later, freed memory would hide the growth
        console().print(
            "memory: {bytes_per_environment:,.0f} bytes an environment".format(**results["memory"])
        )
    for title, makers in groups().items():
        if options.only in title:
            results[title] = measured[title] = measure(build(makers), turns, options.duration)
            report(f"{title}, {turns} alternating turns: median (least to most)", results[title])
    if options.only in "families":
        results["families"] = families()
        text = ", ".join(
            f"{name} {duration:.2f} s" for name, duration in results["families"].items()
        )
        console().print(f"families, in a process of their own, one after the other: {text}")
    if options.only in "learning":
        results["learning"] = learning()
        for name, numbers in results["learning"].items():
            text = f"PPO, {name}: {numbers['steps_per_second']:,.0f} steps/s"
            console().print(
                f"{text}, {numbers['share_in_environment']:.1%} of the time in the environment"
            )
    if options.publish:
        publish(measured)
    if options.out is not None:
        versions = {
            "codrl_mj": codrl_mj.__version__,
            "mujoco": mujoco.__version__,
            "gymnasium": gymnasium.__version__,
        }
        machine = {"cpus": os.cpu_count(), "platform": platform.platform()}
        write_json(
            options.out,
            {"versions": versions, "machine": machine, "turns": turns, "results": results},
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
