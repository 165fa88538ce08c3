"""Train an agent through an actuator from Python, like `codrl-mj train` with its defaults.

Example: python scripts/train.py pendulum sac weak --total-steps 20000 --out runs/pendulum-sac-weak
"""

import argparse
from pathlib import Path

from codrl_mj.training import Progress, TrainConfig, train


def report(progress: Progress) -> None:
    """Print the progress of a training."""
    print(f"{progress.steps:>10,} steps  mean return {progress.mean_return:10.2f}", flush=True)


def main() -> None:
    """Train, or resume a training that was stopped."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", help="such as cartpole; or module:NAME of a custom task")
    parser.add_argument("agent", help="such as ppo; or module:Class of a custom agent")
    parser.add_argument(
        "actuator", help="such as paper, weak or lag; a YAML file; or module:NAME of a custom one"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-steps", type=int, default=200_000)
    parser.add_argument("--out", type=Path, required=True, help="run folder")
    options = parser.parse_args()

    budget = {"total_steps": options.total_steps, "total_episodes": None, "seed": options.seed}
    config = TrainConfig.preset(options.task, options.agent, actuator=options.actuator, **budget)
    print(f"wrote {train(config, options.out, report, resume=True)}")


if __name__ == "__main__":
    main()
