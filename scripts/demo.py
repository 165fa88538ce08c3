"""Demonstrate codrl_mj in one command: learn to balance through a weak actuator.

Cross-validates CartPole against Gymnasium, trains the same agent twice (on the ideal actuator and
through the actuator `weaker`), deploys both policies on `weaker`, prints one table and films them
side by side in a typical episode.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from codrl_mj.cli.evaluate import print_evaluations
from codrl_mj.cli.terminal import progress_bar
from codrl_mj.cli.train import training_bars
from codrl_mj.cli.validate import print_checks
from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import run_episodes, summarize
from codrl_mj.runs import CONFIG
from codrl_mj.runs.policies import load_policy
from codrl_mj.study.grid import failure_record, train_runs
from codrl_mj.tasks import named_actuator
from codrl_mj.training import TrainConfig, TrainingStoppedError, finished, load_config
from codrl_mj.validation import validate
from codrl_mj.viz.films.film import Panel, film

TASK, REAL = "cartpole", "weaker"
# The paper gives no reward farther than 0.1 m from the center.
PAPER_REWARD = {"center_radius": 0.1}


def main() -> int:
    """Run the demonstration."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/demo"), help="folder for runs and video"
    )
    parser.add_argument("--seed", type=int, default=0, help="training seed")
    parser.add_argument(
        "--total-steps", type=int, default=200_000, help="training steps of each policy"
    )
    parser.add_argument(
        "--episodes", type=int, default=100, help="test episodes of each row of the table"
    )
    options = parser.parse_args()

    print("1/4  Is the MuJoCo cart-pole Gymnasium's?")
    with progress_bar() as bar:
        row = bar.add_task("cross-validating", total=None)
        groups = "dynamics", "trajectories"
        certificate = validate(
            TASK, groups=groups, on_part=lambda done, *_: bar.update(row, completed=done)
        )
    print_checks(certificate.checks)
    if not certificate.passed:
        return 1

    print(f"\n2/4  Train PPO twice: on the ideal actuator, and through the actuator {REAL!r}")
    runs = {
        actuator: (
            TrainConfig(
                EnvConfig(TASK, actuator, options=PAPER_REWARD),
                seed=options.seed,
                total_steps=options.total_steps,
            ),
            options.out / f"{actuator}-seed{options.seed}",
        )
        for actuator in ("ideal", REAL)
    }
    waiting = {}
    for actuator, (config, out) in runs.items():
        # A folder with other settings is neither overwritten nor taken for this demonstration's.
        if (out / CONFIG).is_file() and load_config(out) != config:
            print(
                f"demo: {out} holds a run with other settings: choose another --out, or delete it",
                file=sys.stderr,
            )
            return 2
        if finished(out):
            print(f"     {out} is trained already (delete it to train again)")
        else:
            waiting[f"trained on {actuator}"] = (config, out)
    if waiting:
        with training_bars(waiting):
            failures = train_runs(
                {out: config for config, out in waiting.values()}, accept_changes=True
            )
        for out, error in failures.items():
            print(f"demo: {out}: {error} (see {failure_record(out)})", file=sys.stderr)
        if failures:
            return 1

    print(f"\n3/4  Deploy both on {REAL!r}, under Gymnasium's own reward: 500 is full marks")
    evaluations, on_real = {}, {}
    for trained, (_, out) in runs.items():
        policy = load_policy(out)
        for deployed in ("ideal", REAL):
            motor = named_actuator(deployed, TASK)
            episodes = run_episodes(policy, EnvConfig(TASK, motor).build, options.episodes)
            evaluations[f"trained on {trained}, run on {deployed}"] = summarize(TASK, episodes)
            if deployed == REAL:
                on_real[f"trained on {trained}"] = episodes
    print_evaluations(evaluations, details=False)

    print(f"\n4/4  Film both on {REAL!r}, in the same typical episode")
    # The typical episode has returns close to the medians of both policies.
    returns = np.array([[episode.total for episode in episodes] for episodes in on_real.values()])
    typical = int(np.abs(returns - np.median(returns, axis=1, keepdims=True)).sum(axis=0).argmin())
    panels = [
        Panel(TASK, episodes[typical], title=f"{name}: {episodes[typical].total:.0f} of 500")
        for name, episodes in on_real.items()
    ]
    with progress_bar("{task.completed}/{task.total} frames") as bar:
        row = bar.add_task("filming", total=None)
        video = film(
            panels,
            options.out / "side_by_side.mp4",
            on_frame=lambda done, total: bar.update(row, completed=done, total=total),
        )
    print(f"\nOpen {video}")
    for trained, (_, out) in runs.items():
        print(f"Open {out / 'learning_curve.png'} (the learning curve, trained on {trained})")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except TrainingStoppedError as stopped:
        print(f"demo: {stopped}", file=sys.stderr)
        sys.exit(128 + stopped.signal_number)
