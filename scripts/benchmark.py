"""Compare the speed of codrl_mj's environments with other libraries', side by side in one run.

The members of a group take turns: A, B, C, A, B, C, ... with many steps a turn. The table shows the
median ratio to the group's first member, over the turns, with the range. Libraries that are not
installed are skipped.

`--publish` replaces the measured groups in docs/results/speed.csv and rewrites docs/speed.md.
`--quick` compares with scripts/ratios.json instead, in two minutes, and fails if anything became
slower. A commit that slows something down on purpose says why and updates the ratios with `--keep`.
Trainings are measured by scripts/benchmark_training.py.
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
from codrl_mj.tasks import PAPER_TASKS

Makers = list[Callable[[], Subject]]
NUM_ENVS = 1024
BOUGHT = "maxon-ec45-flat-50w"
# Of EnvPool's dm_control swing-ups only Pendulum's: creating a thousand others takes minutes.
ENVPOOL = {
    "pendulum": ("Pendulum-v1", "PendulumSwingup-v1"),
    "cartpole": ("CartPole-v1",),
    "acrobot": ("Acrobot-v1",),
    "mountain_car": ("MountainCar-v0",),
    "mountain_car_continuous": ("MountainCarContinuous-v0",),
}
TASKS = {task.name: task for task in PAPER_TASKS}
# The walls of these tasks are checked after each integration step, with a call of the engine each.
APART = ("mountain_car", "mountain_car_continuous")
RATIOS = Path(__file__).with_name("ratios.json")
"""Group -> member -> its stored ratio to the group's first member."""
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
"""Group -> its title on the page."""
SLOWER = 0.85
"""Fraction of a stored ratio below which a member counts as slower."""
TRIES = 4
"""Maximum number of measurements of a group; the best one counts.

Other processes make a measurement slower, and nothing makes it faster.
"""
DM_CONTROL = {"pendulum": "swingup", "cartpole": "swingup", "acrobot": "swingup"}


def quick_groups() -> dict[str, Makers]:
    """Return the groups of `--quick`: single steps, batches, engine, a third-party environment."""
    groups_by_title: dict[str, Makers] = {
        "single: pendulum": [
            partial(subjects.gymnasium_env, "Pendulum-v1"),
            partial(subjects.ours, "pendulum", "paper"),
        ],
        "single: cartpole": [
            partial(subjects.gymnasium_env, "InvertedPendulum-v5"),
            partial(subjects.ours, "cartpole", "paper"),
        ],
        "foreign: HalfCheetah-v5": [
            partial(subjects.without_motors, "HalfCheetah-v5", BOUGHT),
            partial(subjects.foreign, "HalfCheetah-v5", BOUGHT),
        ],
        "engine: pendulum": [
            partial(subjects.engine, "pendulum", actuator) for actuator in (None, "paper", "drive")
        ],
    }
    for task in ("pendulum", "cartpole", "acrobot"):
        groups_by_title[f"two threads: {task}"] = [
            subject(task, NUM_ENVS, 2) for subject in (_batch, _vector)
        ]
    return groups_by_title


def _batch(task: str, num_envs: int, threads: int) -> Callable[[], Subject]:
    return partial(subjects.raw_batch, task, num_envs, threads, task in APART)


def _vector(task: str, num_envs: int, threads: int) -> Callable[[], Subject]:
    return partial(subjects.vector, task, num_envs, threads)


def compare(keep: bool) -> int:
    """Measure the quick groups and compare them with the stored ratios; return 1 if any is slower.

    Args:
        keep: store the minimum ratios of all tries instead of comparing.
    """
    stored: dict[str, Any] = {} if keep else read_json(RATIOS, "ratios")
    slower = False
    for title, makers in quick_groups().items():
        first, *others = members = build(makers)
        stored_ratios = np.array([0.0 if keep else stored[title][member.name] for member in others])
        # Other processes do not affect processor time, but it adds up over threads.
        clock = time.perf_counter if "threads" in title else time.process_time
        tries: list[list[float]] = []
        while len(tries) < TRIES and (
            keep or not tries or (np.max(tries, axis=0) < SLOWER * stored_ratios).any()
        ):
            results = measure(members, 15, 0.02, clock)
            tries.append([results[member.name]["ratio"][0] for member in others])
        if keep:
            stored[title] = {
                member.name: round(ratio, 3)
                for member, ratio in zip(others, np.min(tries, axis=0), strict=True)
            }
        for member, ratio, stored_ratio in zip(
            others, np.max(tries, axis=0), stored_ratios, strict=True
        ):
            verdict = "  SLOWER" if ratio < SLOWER * stored_ratio else ""
            print(
                f"{title}: {member.name}: {ratio:.3f} of {first.name}, was {stored_ratio:.3f}"
                f"{verdict}",
                flush=True,
            )
            slower |= bool(verdict)
    if keep:
        write_json(RATIOS, stored)
    return int(slower)


def groups() -> dict[str, Makers]:
    """Return all groups; the speeds of a group are divided by its first member's."""
    groups_by_title: dict[str, Makers] = {}
    for task in TASKS:
        groups_by_title[f"engine: {task}"] = [
            partial(subjects.engine, task, actuator)
            for actuator in (None, "paper", "drive", "stepped")
        ]
    for count in (1, 6, 17):
        drivers = (None, "ideal", "torque_speed", "lag", "current_loop")
        groups_by_title[f"motorised: {count} motors"] = [
            partial(subjects.chain, count, driver) for driver in drivers
        ]
    for env_id in ("HalfCheetah-v5", "Humanoid-v5"):
        actuators = (None, "ideal", "lag", "torque_speed", BOUGHT)
        groups_by_title[f"foreign: {env_id}"] = [
            partial(subjects.foreign, env_id, driver) for driver in actuators
        ]
        groups_by_title[f"foreign: {env_id}"].append(
            partial(subjects.without_motors, env_id, BOUGHT)
        )
    for task, definition in TASKS.items():
        assert definition.gymnasium_id is not None
        members: Makers = [partial(subjects.gymnasium_env, definition.gymnasium_id)]
        members += [partial(subjects.ours, task, actuator) for actuator in ("paper", "ideal")]
        if task == "cartpole":
            members.append(partial(subjects.gymnasium_env, "InvertedPendulum-v5"))
        if task in DM_CONTROL:
            members.append(partial(subjects.dm_control, task, DM_CONTROL[task]))
        if task == "pendulum":
            members.append(subjects.electric_motor)
        groups_by_title[f"single: {task}"] = members
    for task in TASKS:
        members = [partial(subjects.raw_batch, task, NUM_ENVS, 1, apart) for apart in (False, True)]
        members += [
            partial(subjects.vector, task, NUM_ENVS, 1, actuator) for actuator in ("paper", "ideal")
        ]
        members += [partial(subjects.envpool, name, NUM_ENVS, 1) for name in ENVPOOL[task]]
        groups_by_title[f"vector: {task}"] = members
        apart = task in APART
        members = [
            partial(subjects.raw_batch, task, NUM_ENVS, 2, apart),
            partial(subjects.vector, task, NUM_ENVS, 2),
        ]
        groups_by_title[f"two threads: {task}"] = members
    for count in (NUM_ENVS, 16_384):
        pair = (
            partial(subjects.envpool, "Pendulum-v1", count, 2),
            partial(subjects.vector, "pendulum", count, 2),
        )
        groups_by_title[f"EnvPool: {count}"] = list(pair)
    cores = sorted({1, 2, num_cpus()})
    sizes = [
        (num_envs, threads) for num_envs in (NUM_ENVS, 1, 64, 16_384, 100_000) for threads in cores
    ]
    for task in TASKS:
        groups_by_title[f"sizes: {task}"] = [
            partial(subjects.vector, task, *size) for size in sizes
        ]
    for task in ("cartpole", "mountain_car"):
        groups_by_title[f"drawing: {task}"] = [
            partial(subjects.drawing, task, fast) for fast in (False, True)
        ]
    return groups_by_title


def build(makers: Makers) -> list[Subject]:
    """Create the members of a group; print those that fail, such as missing libraries, and why."""
    members = []
    for make in makers:
        try:
            members.append(make())
        # A library may be missing, or may not work with the versions that are installed here.
        except Exception as error:
            arguments = ", ".join(map(str, getattr(make, "args", ())))
            name = getattr(make, "func", make).__name__
            console().print(
                f"skipped: {name} {arguments}: {type(error).__name__}: {error}", markup=False
            )
    return members


def seconds(member: Subject, calls: int, clock: Callable[[], float]) -> float:
    """Return the time that a number of calls takes [s]."""
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
        Steps per second and their ratio to the first member's, by name: (median, min, max) each.
    """
    calls = []
    for member in members:
        # The first call compiles.
        seconds(member, 1, clock)
        count = 1
        while (elapsed := seconds(member, count, clock)) < turn_duration / 4 and count < 1_000_000:
            count *= 4
        calls.append(max(1, round(count * turn_duration / elapsed)))
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
    """Return the memory of a Pendulum environment in a batch [bytes], measured at N = 16384."""
    page, num_envs = os.sysconf("SC_PAGE_SIZE"), 16384

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * page

    before = resident()
    env = gymnasium.make_vec(TASKS["pendulum"].env_id, num_envs, "vector_entry_point")
    env.reset(seed=0)
    env.step(np.zeros((num_envs, 1), np.float32))
    return {"bytes_per_environment": (resident() - before) / num_envs}


def learning() -> dict[str, dict[str, float]]:
    """Return PPO's environment steps per second, and the share of the time spent in stepping."""
    results = {}
    for num_envs, ours in ((8, False), (64, True), (256, True)):
        name, train = subjects.ppo(num_envs, ours)
        # Warm-up: the first rollout compiles.
        train(2048)
        steps = 20480
        start = time.perf_counter()
        share = train(steps)
        results[name] = {
            "steps_per_second": steps / (time.perf_counter() - start),
            "share_in_environment": share,
        }
    return results


def families() -> dict[str, float]:
    """Return the seconds until each family runs in the engine, in order; one process for all."""
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
    """Print the table of a group."""
    table = Table(title=title, title_justify="left")
    for column in ("", "steps/s", "ratio to the first"):
        table.add_column(column, justify="right" if column else "left")
    for name, spreads in results.items():
        ratio = "{:.2f} ({:.2f} to {:.2f})".format(*spreads["ratio"])
        table.add_row(name, f"{spreads['steps_per_second'][0]:,.0f}", ratio)
    console().print(table)


def publish(
    results: dict[str, dict[str, dict[str, list[float]]]], file: Path = ROWS, page: Path = PAGE
) -> None:
    """Put groups among the rows of a CSV file, and rewrite the tables of a page."""
    rows = [row for row in read_csv(file) if row["group"] not in results]
    for group, members in results.items():
        for name, spreads in members.items():
            speed = spreads["steps_per_second"][0]
            ratio = [f"{value:.3f}" for value in spreads["ratio"]]
            row = {"group": group, "member": name, "steps_a_second": f"{speed:.0f}"}
            rows.append(row | dict(zip(("ratio", "least", "most"), ratio, strict=True)))
    write_csv(file, rows)
    # The page shows all published groups, also those that this run did not measure.
    tables = []
    for group, title in SHOWN.items():
        group_rows = [row for row in rows if row["group"] == group]
        cells = [
            (row["member"], f"{int(row['steps_a_second']):,}", f"{float(row['ratio']):.2f}")
            for row in group_rows
        ]
        tables.append(
            markdown_table((title, "steps a second", "times the first"), cells, 2) if cells else ""
        )
    write_page(page, [page.read_text().partition(WRITTEN)[0] + WRITTEN, *tables])


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="compare with the stored ratios: two minutes"
    )
    parser.add_argument("--keep", action="store_true", help="measure and store the ratios")
    parser.add_argument(
        "--only", default="", help="only groups whose name contains this, such as 'vector'"
    )
    parser.add_argument("--turns", type=int, default=11, help="turns of each member of a group")
    parser.add_argument("--duration", type=float, default=0.1, help="duration of a turn [s]")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    parser.add_argument(
        "--publish", action="store_true", help="write the groups' rows and their page in docs/"
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
        # Memory comes first: later, freed memory would hide the growth.
        results["memory"] = memory()
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
