"""Measure what trainings cost: processor time until evaluations reach a return, and in total.

    python scripts/training_cost.py cartpole pendulum --seeds 5
    python scripts/training_cost.py acrobot --actuator ideal --changes '{"num_envs": 8}'

Compilation, which a process does once, is left out: a short training comes first. Processor time is
the sum over all threads.
"""

import argparse
import dataclasses
import json
import math
import tempfile
import time
from pathlib import Path
from typing import Any

from codrl_mj.runs.files import read_json
from codrl_mj.training import Progress, TrainConfig, train

ENOUGH = {
    "cartpole": 475.0,
    "pendulum": -200.0,
    "acrobot": -100.0,
    "mountain_car": -150.0,
    "mountain_car_continuous": 90.0,
    "furuta": 200.0,
}
"""Task -> mean return of an evaluation at which the task counts as learned."""


class Clock:
    """Progress callback that records when evaluations are good enough."""

    def __init__(self, enough: float) -> None:
        """Start the clock."""
        self.enough, self.start = enough, time.process_time()
        self.learned = "-"
        self.curve: list[str] = []

    def __call__(self, progress: Progress) -> None:
        """Record the evaluation of a progress report, if it has one."""
        if math.isnan(progress.evaluation_return):
            return
        self.curve.append(f"{progress.evaluation_return:.0f}")
        if self.learned == "-" and progress.evaluation_return >= self.enough:
            self.learned = f"{progress.steps:6d} steps {self.seconds:5.1f} s"

    @property
    def seconds(self) -> float:
        """Processor time since the start [s]."""
        return time.process_time() - self.start


def run(config: TrainConfig, enough: float) -> tuple[Clock, dict[str, Any]]:
    """Train in a temporary folder."""
    clock = Clock(enough)
    with tempfile.TemporaryDirectory() as folder:
        out = train(config, Path(folder) / "run", on_progress=clock, tensorboard=False)
        return clock, read_json(out / "result.json", "result")


def main() -> None:
    """Print a line for each training."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="+", choices=list(ENOUGH), metavar="TASK")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--agent", default="ppo")
    parser.add_argument("--actuator", default="default")
    parser.add_argument(
        "--changes",
        type=json.loads,
        default={},
        help="JSON of configuration keys to change",
    )
    options = parser.parse_args()
    for task in options.tasks:
        changes = dict(options.changes)
        agent = {"name": options.agent, **changes.pop("agent", {})}
        config = TrainConfig.from_mapping(
            {"task": task, "actuator": options.actuator, "agent": agent, **changes}
        )
        run(dataclasses.replace(config, total_steps=1, total_episodes=None), 0.0)
        for seed in range(options.seeds):
            clock, result = run(dataclasses.replace(config, seed=seed), ENOUGH[task])
            print(
                f"{task} {options.agent} {options.actuator} seed {seed}: learned after"
                f" {clock.learned}; in all {result['steps']} steps {clock.seconds:5.1f} s,"
                f" {result['steps'] / clock.seconds:5.0f} steps/s; evaluations"
                f" {' '.join(clock.curve)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
