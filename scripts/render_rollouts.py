"""Film a trained policy on several actuators side by side, off screen.

Example: python scripts/render_rollouts.py runs/cartpole-ppo-ideal-0 ideal weaker --out rollouts.mp4
"""

import argparse
import dataclasses
from pathlib import Path

from codrl_mj.evaluation import run_episodes
from codrl_mj.runs.policies import load_policy
from codrl_mj.training import load_config
from codrl_mj.viz.films.film import Panel, film


def main() -> None:
    """Run an episode on each actuator and film them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="run folder of a finished training")
    parser.add_argument("actuators", nargs="+", help="actuators, such as ideal or weaker")
    parser.add_argument("--seed", type=int, default=0, help="seed of the episode")
    parser.add_argument("--out", type=Path, default=Path("rollouts.mp4"))
    options = parser.parse_args()

    trained, policy = load_config(options.run).env, load_policy(options.run)
    panels = []
    for name in options.actuators:
        # A time limit of the training does not apply to the film.
        env = dataclasses.replace(trained, actuator=name, max_episode_steps=None)
        (episode,) = run_episodes(policy, env.build, 1, options.seed)
        panels.append(Panel(env.task, episode, title=f"on {name}: return {episode.total:.0f}"))
    print(f"wrote {film(panels, options.out)}")


if __name__ == "__main__":
    main()
