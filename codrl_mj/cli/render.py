"""`codrl-mj render`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import tyro

from codrl_mj.cli.fields import AS_TRAINED, ActuatorName, environment, is_task
from codrl_mj.cli.subject import Source
from codrl_mj.tasks import find_task


@dataclasses.dataclass(frozen=True)
class Render:
    """Film one episode: the scene, and a strip of desired and actual torque and the voltage below it.

    Example: codrl-mj render runs/cartpole-ppo-weaker-0 --out balance.mp4, or codrl-mj render cartpole (random actions).
    """

    subject: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            help="Run folder, a folder with a policy alone, or a Stable-Baselines3 zip (see --trust); or a task name "
            "for random actions."
        ),
    ]
    source: tyro.conf.OmitArgPrefixes[Source] = Source()
    actuator_name: ActuatorName = AS_TRAINED
    seed: int = 0
    """Seed of the episode."""
    out: Path = Path("episode.mp4")
    """File to write: .mp4 (H.264) or .gif; without a suffix, a folder of PNG frames."""
    trajectory: Path | None = None
    """File for the episode itself, .npz: time, state, observation, action, reward and every actuator signal."""
    width: int = 640
    """Width [px], even."""
    height: int = 480
    """Height of the scene [px], even."""
    camera: str = "fixed"
    """A camera of the model: fixed or close."""
    pretty: bool = False
    """Shadows, reflections and multisampling: slower."""

    def run(self: Any) -> int:
        """Run the episode and film it."""
        from codrl_mj.cli.terminal import progress_bar
        from codrl_mj.evaluation import RandomPolicy, run_episodes, save_episode
        from codrl_mj.films.film import Panel, film
        from codrl_mj.runs.policies import Policy

        if is_task(self.subject):
            task, name = self.subject, self.actuator_name
            name = find_task(task).default_actuator if name == AS_TRAINED else name
            env = environment(self, task, name)
            policy: Policy = RandomPolicy(env.make().action_space, self.seed)
        else:
            loaded, name = self.source.load(Path(self.subject)), self.actuator_name
            task, policy = loaded.env.task, loaded.policy
            env = environment(self, task, name, loaded.env.actuator)
            loaded.check_interface(env)
        (episode,) = run_episodes(policy, env.make, 1, self.seed)
        title = f"{Path(self.subject).name} on {name}: return {episode.total:.0f}"
        panel = Panel(title, task, env.actuator, episode)
        with progress_bar("{task.completed}/{task.total} frames") as bar:
            row = bar.add_task("filming", total=None)
            film(
                [panel],
                self.out,
                self.width,
                self.height,
                self.camera,
                self.pretty,
                lambda done, total: bar.update(row, completed=done, total=total),
            )
        print(f"wrote {self.out}")
        if self.trajectory is not None:
            save_episode(episode, self.trajectory)
            print(f"wrote {self.trajectory}")
        return 0
