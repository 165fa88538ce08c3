"""`codrl-mj replay`."""

import dataclasses
from pathlib import Path
from typing import Any

import tyro

from codrl_mj.cli.fields import AS_TRAINED, ActuatorName, with_environment
from codrl_mj.cli.subject import Source, SubjectWord, policy_and_environment, title_of


@dataclasses.dataclass(frozen=True)
class Replay:
    """Write one episode as a page in three dimensions: to be turned, scrubbed and played at any speed.

    Example: codrl-mj replay runs/cartpole-ppo-weaker-0 --out balance.html, or codrl-mj replay Ant-v5 (random actions).
    """

    subject: SubjectWord
    source: tyro.conf.OmitArgPrefixes[Source] = Source()
    actuator_name: ActuatorName = AS_TRAINED
    seed: int = 0
    """Seed of the episode."""
    out: Path = Path("episode.html")
    """File to write."""

    for_line = classmethod(with_environment)

    def run(self: Any) -> int:
        """Run the episode and write it."""
        from codrl_mj.evaluation import run_episodes
        from codrl_mj.replay import motion_of_episode, write_replay

        policy, env = policy_and_environment(self)
        (episode,) = run_episodes(policy, env.make, 1, self.seed)
        title = f"{title_of(self.subject, env)}: return {episode.total:.0f}"
        write_replay(motion_of_episode(episode, env), self.out, title)
        print(f"wrote {self.out} ({self.out.stat().st_size / 1e6:.1f} MB)")
        return 0
