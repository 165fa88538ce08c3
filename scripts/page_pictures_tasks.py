"""Film every task of docs/environments: a policy that was trained through the task's motor, and what the motor does.

A film has the first seconds of a typical episode, and under it the strip of torque and voltage.
`PICTURES` has what makes each, by its path below docs. Example: python
scripts/page_pictures_tasks.py furuta; all six take five minutes.
"""

import argparse
import dataclasses
import functools
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import run_episodes
from codrl_mj.runs.files import atomic_write
from codrl_mj.runs.policies import load_policy
from codrl_mj.training import EVALUATION_SEED, TrainConfig, train
from codrl_mj.viz.films.film import Panel, film

DOCS = Path(__file__).parents[1] / "docs"
WIDTH, HEIGHT = 320, 200
"""Of the scene [px]; title and strip add to its height."""
FRAMES, DURATION, LAST = 45, 3000, 1500
"""Most frames of a film, how long it lasts, and how long its last frame stands still [ms]."""


class Scene(NamedTuple):
    """What is filmed of a task."""

    agent: str
    settings: str
    steps: int | None
    """Environment steps that are shown; None: to the end of the episode."""
    camera: str = "fixed"

    @property
    def flags(self) -> str:
        """With which `codrl-mj train` trains the policy."""
        return f"--agent {self.agent}" + f" --settings {self.settings}" * (
            self.settings != "default"
        )


SCENES: Mapping[str, Scene] = {
    "pendulum": Scene("ppo", "fast", 60),
    "cartpole": Scene("ppo", "fast", 50, "close"),
    "acrobot": Scene("sarsa", "default", None),
    "mountain_car": Scene("sarsa", "default", None),
    "mountain_car_continuous": Scene("sac", "default", None),
    "furuta": Scene("ppo", "default", 150),
}


def make(task: str, path: Path) -> None:
    """Train a policy of a task through the task's own motor, and film a typical episode."""
    scene = SCENES[task]
    with tempfile.TemporaryDirectory() as made:
        run = train(
            TrainConfig.preset(task, scene.agent, scene.settings),
            Path(made) / "run",
            tensorboard=False,
        )
        env = EnvConfig(task)
        if scene.steps is not None:
            env = dataclasses.replace(env, max_episode_steps=scene.steps)
        episodes = run_episodes(load_policy(run), env.make, 21, EVALUATION_SEED)
        typical = episodes[
            int(np.argsort([episode.total for episode in episodes])[len(episodes) // 2])
        ]
        title = f"{scene.agent.upper()}, {len(typical.reward) * float(typical.time[0]):g} s"
        panel = Panel(task, typical, title=title)
        frames = film([panel], Path(made) / "film", WIDTH, HEIGHT, scene.camera)
        images = sorted(frames.iterdir())[:-1]  # the last one is faded, and says how it ended
        chosen = sorted({round(at) for at in np.linspace(0, len(images) - 1, FRAMES)})
        first, *others = (Image.open(images[at]).convert("RGB") for at in chosen)
        shown = [round(DURATION / len(chosen))] * len(others) + [LAST]
        with atomic_write(path) as temporary:
            first.save(
                temporary,
                "webp",
                save_all=True,
                append_images=others,
                duration=shown,
                loop=0,
                quality=60,
                method=6,
            )


PICTURES: Mapping[str, Callable[[Path], None]] = {
    f"environments/{task}.webp": functools.partial(make, task) for task in SCENES
}


def main() -> None:
    """Make the films of some tasks, or of all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", choices=[*SCENES, []], help="all unless some are named")
    options = parser.parse_args()
    for task in options.tasks or SCENES:
        name = f"environments/{task}.webp"
        PICTURES[name](DOCS / name)
        print(f"wrote {DOCS / name}")


if __name__ == "__main__":
    main()
