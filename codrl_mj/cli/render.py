"""`codrl-mj render`."""

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from codrl_mj.cli.fields import AS_TRAINED, ActuatorName, with_environment
from codrl_mj.cli.subject import Source, SubjectWord, policy_and_environment, title_of
from codrl_mj.fields import did_you_mean


@dataclasses.dataclass(frozen=True)
class Render:
    """Film one episode: the scene, and a strip of desired and actual torque and the voltage below it.

    Example: codrl-mj render runs/cartpole-ppo-weaker-0 --out balance.mp4, or codrl-mj render cartpole (random actions).
    """

    subject: SubjectWord
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
    """A camera of the model: fixed or close; other models have others, and fixed is their environment's own."""
    pretty: bool = False
    """Shadows, reflections and multisampling: slower."""
    motor: str | None = None
    """Of several motors that whose torque and voltage the strip shows, by its name; the first unless given."""

    for_line = classmethod(with_environment)

    def run(self: Any) -> int:
        """Run the episode and film it."""
        from codrl_mj.cli.terminal import progress_bar
        from codrl_mj.evaluation import save_episode
        from codrl_mj.films.film import check_film, film, record

        check_film(self.out, self.width, self.height)
        if self.trajectory is not None and self.trajectory.suffix != ".npz":
            raise ValueError(f"--trajectory {self.trajectory}: the suffix is {self.trajectory.suffix!r}, must be .npz")
        policy, env = policy_and_environment(self)
        panel = record(policy, env, self.seed, self.width, self.height, self.camera, self.pretty)
        episode = panel.episode
        title = f"{title_of(self.subject, env)}: return {episode.total:.0f}"
        if episode.motors:
            title += f"; {episode.motors[self._motor(episode)]}"
        panel = dataclasses.replace(panel, title=title, motor=self._motor(episode))
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

    def _motor(self, episode: Any) -> int:
        """Which of the motors the strip shows."""
        if self.motor is None:
            return 0
        names = episode.motors
        if self.motor not in names:
            there = ", ".join(names) or "one, which needs no name"
            raise ValueError(f"--motor {self.motor}: {did_you_mean(self.motor, names)}there are {there}")
        return int(names.index(self.motor))
