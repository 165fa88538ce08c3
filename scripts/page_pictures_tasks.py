"""Film every task of docs/environments: a policy trained through the task's motor, and the motor.

A film shows the first seconds of a typical episode, above a strip of torque and voltage. `PICTURES`
has a function for each, by its path below docs. Example: python scripts/page_pictures_tasks.py
furuta; all six take five minutes.
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
"""Width and height of the scene [px]; title and strip add to the height."""
FRAMES, DURATION, LAST = 45, 3000, 1500
"""Maximum number of frames, duration of a film, and time that its last frame is shown [ms]."""


class Scene(NamedTuple):
    """Agent that learns a task, and the part of the episode that is filmed."""

    agent: str
    settings: str
    steps: int | None
    """Number of environment steps that are shown; None: the whole episode."""
    camera: str = "fixed"

    @property
    def flags(self) -> str:
        """Flags of `codrl-mj train` that train this policy."""
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
    """Train a policy of a task through the task's motor, and film a typical episode."""
    scene = SCENES[task]
    with tempfile.TemporaryDirectory() as folder:
        run = train(
            TrainConfig.preset(task, scene.agent, scene.settings),
            Path(folder) / "run",
            tensorboard=False,
        )
        env = EnvConfig(task)
        if scene.steps is not None:
            env = dataclasses.replace(env, max_episode_steps=scene.steps)
        episodes = run_episodes(load_policy(run), env.build, 21, EVALUATION_SEED)
        typical = episodes[
            int(np.argsort([episode.total for episode in episodes])[len(episodes) // 2])
        ]
        title = f"{scene.agent.upper()}, {len(typical.reward) * float(typical.time[0]):g} s"
        panel = Panel(task, typical, title=title)
        frames = film([panel], Path(folder) / "film", WIDTH, HEIGHT, scene.camera)
        # The last frame is faded, and says how the episode ended.
        images = sorted(frames.iterdir())[:-1]
        chosen = sorted({round(index) for index in np.linspace(0, len(images) - 1, FRAMES)})
        first, *later_images = (Image.open(images[index]).convert("RGB") for index in chosen)
        shown = [round(DURATION / len(chosen))] * len(later_images) + [LAST]
        with atomic_write(path) as temporary:
            first.save(
                temporary,
                "webp",
                save_all=True,
                append_images=later_images,
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
    parser.add_argument("tasks", nargs="*", choices=[*SCENES, []], help="default: all")
    options = parser.parse_args()
    for task in options.tasks or SCENES:
        name = f"environments/{task}.webp"
        PICTURES[name](DOCS / name)
        print(f"wrote {DOCS / name}")


if __name__ == "__main__":
    main()
