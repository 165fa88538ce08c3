"""Evaluate the policies in MJX and in our engine, from the same initial states.

Example: python compare.py policies
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from results import Row, table, write_rows
from swing_up import ACTUATORS, TIME_LIMIT
from swing_up_mjx import Worlds

from codrl_mj.envs.config import EnvConfig
from codrl_mj.evaluation import evaluate
from codrl_mj.runs.policies import Policy, load_policy

TASK = "swing_up:SwingUp-v0"
NUM_EPISODES = 64
"""Number of initial states, which is also that of the worlds in MJX."""
SEED = 1_000_000
"""Seed of the first episode in our engine."""


class Episodes(NamedTuple):
    """Episodes that begin at the same time."""

    returns: np.ndarray
    """Returns, shape (episodes,)."""
    positions: np.ndarray
    """Angles of the rods after each step [rad], shape (steps, episodes)."""


def initial_states(num: int = NUM_EPISODES) -> np.ndarray:
    """Return angles and speeds with which our engine begins its episodes, shape (2, num)."""
    env = gymnasium.make(TASK)
    states = []
    for seed in range(SEED, SEED + num):
        env.reset(seed=seed)
        data: Any = env.unwrapped.data
        states.append([data.qpos[0], data.qvel[0]])
    env.close()
    return np.array(states).T


def play(policy: Policy, worlds: Worlds, states: np.ndarray) -> Episodes:
    """Run episodes in MJX from states, shape (2, worlds)."""
    observations = worlds.restart(*states)
    returns, positions = np.zeros(worlds.num_envs), []
    for step in range(TIME_LIMIT):
        actions, _ = policy.predict(observations, deterministic=True)
        observations, rewards, _, _ = worlds.step(actions)
        returns += rewards
        # The last step begins a new episode.
        if step < TIME_LIMIT - 1:
            positions.append(worlds.positions)
    return Episodes(returns, np.array(positions))


def main() -> None:
    """Evaluate all policies on both actuators, and write and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policies", type=Path, help="folder of train_mjx.py")
    folder = parser.parse_args().policies
    states, rows = initial_states(), []
    worlds = {name: Worlds(actuators, NUM_EPISODES) for name, actuators in ACTUATORS.items()}
    for each in worlds.values():
        each.seed(0)
    for path in sorted(path.parent for path in folder.glob("*/policy.json")):
        policy = load_policy(path)
        trained, seed = path.name.split("-")
        for tested, actuators in ACTUATORS.items():
            in_mjx = play(policy, worlds[tested], states).returns
            ours = evaluate(policy, EnvConfig(TASK, actuators), NUM_EPISODES, SEED)
            row: Row = {
                "trained on": trained,
                "tested on": tested,
                "seed": int(seed),
                "MJX": round(float(in_mjx.mean()), 3),
                "ours": round(ours.returns.mean, 3),
                "success": round(ours.success.mean if ours.success else 0.0, 4),
            }
            row["largest gap of an episode"] = round(
                float(np.abs(in_mjx - np.array(ours.episode_returns)).max()), 3
            )
            rows.append(row)
            print(row, flush=True)
    rows.sort(key=lambda row: (str(row["trained on"]), str(row["tested on"]), int(row["seed"])))
    write_rows(rows, folder / "returns.csv")
    print(table(rows))


if __name__ == "__main__":
    main()
