"""Train policies in MJX, on ideal torques and through the motor, and save them for our engine.

Example: python train_mjx.py --out policies. A policy takes half a minute of one core.
"""

import argparse
import time
from pathlib import Path

import torch
from results import Row, draw_learning_curves, write_rows
from swing_up import ACTUATORS, TIME_LIMIT
from swing_up_mjx import Worlds

from codrl_mj.agents import PPOConfig
from codrl_mj.runs.policies import save_policy

# Our PPO, which is Stable-Baselines3's. Its policies are files that `codrl-mj` evaluates.
AGENT = PPOConfig(
    rollout_steps=4096, batch_size=512, gae_lambda=0.95, unit_actions=True, log_std_init=-0.5
)
NUM_WORLDS = 64


def train(worlds: Worlds, seed: int, num_steps: int, folder: Path) -> list[float]:
    """Train a policy, save it, and return the mean return of the worlds in each episode."""
    model = AGENT.make_model(worlds, seed)
    model.learn(num_steps)
    folder.mkdir(parents=True, exist_ok=True)
    save_policy(model.policy, AGENT, folder)
    return worlds.mean_returns


def main() -> None:
    """Train the policies, and write the learning curves."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("policies"), help="folder for policies")
    parser.add_argument("--seeds", type=int, default=5, help="policies of each kind")
    parser.add_argument("--steps", type=int, default=200_000, help="steps of a training")
    options = parser.parse_args()
    # Small networks are faster on one thread.
    torch.set_num_threads(1)
    rows: list[Row] = []
    for name, actuators in ACTUATORS.items():
        worlds = Worlds(actuators, NUM_WORLDS)
        for seed in range(options.seeds):
            start, cpu_start = time.perf_counter(), time.process_time()
            returns = train(worlds, seed, options.steps, options.out / f"{name}-{seed}")
            for episode, value in enumerate(returns, start=1):
                steps = episode * TIME_LIMIT * NUM_WORLDS
                rows.append(
                    {"trained on": name, "seed": seed, "steps": steps, "return": round(value, 1)}
                )
            print(
                f"{name}-{seed}: {time.perf_counter() - start:.0f} s, of which"
                f" {time.process_time() - cpu_start:.0f} s on a core; last return"
                f" {returns[-1] if returns else float('nan'):.0f}",
                flush=True,
            )
    write_rows(rows, options.out / "learning_curves.csv")
    draw_learning_curves(rows, options.out / "learning_curves.png")


if __name__ == "__main__":
    main()
