"""Speed of the motor in the loop, beside what it is built on; every ratio is measured side by side in this one run.

Each pair alternates: A, B, A, B, ... with many steps a turn; the table has the median of the ratios, turn by turn, with
their range.
"""

import codrl_mj  # isort: skip - before mujoco, which chooses its OpenGL platform when it is imported

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
from rich.table import Table

from codrl_mj import callbacks
from codrl_mj.env_config import EnvConfig
from codrl_mj.evaluation import make_env
from codrl_mj.files import write_json
from codrl_mj.motor import named_actuator
from codrl_mj.physics.mjcf import install_callbacks, task_model
from codrl_mj.physics.offscreen import OffscreenRenderer
from codrl_mj.tasks import TASKS
from codrl_mj.terminal import console, progress_bar

Turn = Callable[[int], None]


def engine(task: str, with_callbacks: bool) -> Turn:
    """`mj_step` of the task's model; without our callbacks its motor is dead weight, and a hill is flat."""
    definition = TASKS[task]
    timestep = definition.step_duration / definition.motor_inner_steps
    model = task_model(definition, named_actuator("paper", task), timestep)
    data = mujoco.MjData(model)

    def turn(steps: int) -> None:
        callbacks.uninstall()
        if with_callbacks:
            install_callbacks(model)
        mujoco.mj_resetData(model, data)
        data.qpos[:] = 0.3  # in motion in both cases: at rest, a step is cheaper
        data.qvel[:] = 0.1
        data.ctrl[:] = model.actuator_ctrlrange[0, 1] / 2
        mujoco.mj_step(model, data, steps)

    return turn


def environment(make: Callable[[], "gymnasium.Env[object, object]"]) -> Turn:
    """Steps of a Gymnasium environment under precomputed random actions, with resets."""
    env = make()
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(1000)]

    def turn(steps: int) -> None:
        env.reset(seed=0)  # which installs our callbacks where the environment is ours
        for index in range(steps):
            _, _, terminated, truncated, _ = env.step(actions[index % 1000])
            if terminated or truncated:
                env.reset()

    return turn


def drawing(task: str, fast: bool) -> Turn:
    """Frames of 480 x 480 of the task's scene, with our fast visual settings or with MuJoCo's defaults."""
    model = task_model(TASKS[task], None, TASKS[task].step_duration)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    if fast:
        ours = OffscreenRenderer(model)

        def turn(frames: int) -> None:
            for _ in range(frames):
                ours.render(data)

        return turn
    model.vis.quality.shadowsize, model.vis.quality.offsamples = 4096, 4  # MuJoCo's defaults
    theirs = mujoco.Renderer(model, 480, 480)

    def default_turn(frames: int) -> None:
        for _ in range(frames):
            theirs.update_scene(data, "fixed")
            theirs.render()

    return default_turn


def compare(first: Turn, second: Turn, turns: int, steps: int) -> dict[str, list[float]]:
    """Time two alternatives in turn; `ratio` is the first's speed over the second's: (median, least, most)."""
    seconds = np.empty((turns, 2))
    for turn in (first, second):
        turn(steps)  # warm-up
    for row in seconds:
        for column, turn in enumerate((first, second)):
            start = time.perf_counter()
            turn(steps)
            row[column] = time.perf_counter() - start
    ratio = seconds[:, 1] / seconds[:, 0]
    speeds = np.median(steps / seconds, axis=0)
    return {
        "steps_per_second": [float(speed) for speed in speeds],
        "ratio": [float(np.median(ratio)), float(ratio.min()), float(ratio.max())],
    }


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=25, help="turns of each of the two in a pair")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    options = parser.parse_args()

    pairs: dict[str, tuple[Turn, Turn, int]] = {}
    for task in TASKS:
        pairs[f"mj_step of {task}: with our callbacks / bare"] = engine(task, True), engine(task, False), 20_000
    for task, definition in TASKS.items():
        name = definition.gymnasium_id
        ours = environment(lambda task=task: make_env(task, "paper", **EnvConfig().as_arguments()))  # type: ignore[misc]
        theirs = environment(lambda name=name: gymnasium.make(name, disable_env_checker=True))  # type: ignore[misc]
        pairs[f"{task} with motor / Gymnasium {name}"] = ours, theirs, 2_000

    for task in TASKS:
        name = f"frames of {task}: our settings / MuJoCo's defaults"
        pairs[name] = drawing(task, fast=True), drawing(task, fast=False), 10

    results = {}
    table = Table(title=f"speed ratios, {options.turns} alternating turns: median (least to most)")
    for column in ("first / second", "first, 1/s", "second, 1/s", "ratio"):
        table.add_column(column, justify="left" if column == "first / second" else "right")
    with progress_bar("{task.completed}/{task.total}") as bar:
        for name, (first, second, steps) in bar.track(pairs.items(), description="measuring"):
            results[name] = compare(first, second, options.turns, steps)
            speeds, ratio = results[name]["steps_per_second"], results[name]["ratio"]
            table.add_row(
                name,
                *(f"{speed:,.0f}" for speed in speeds),
                "{:.2f} ({:.2f} to {:.2f})".format(*ratio),
            )
    console().print(table)
    if options.out is not None:
        write_json(
            options.out,
            {
                "codrl_mj": codrl_mj.__version__,
                "mujoco": mujoco.__version__,
                "turns": options.turns,
                "results": results,
            },
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
