"""What Furuta policies are worth on weaker supplies and behind delays, trained on the ideal arm and through motors.

Prints a table: the mean return over the seeds, and the worst and the best seed's. Runs that are
finished are not trained again: half an hour of one core for three seeds.
"""

import argparse
from pathlib import Path
from typing import Any

from codrl_mj import EnvConfig
from codrl_mj.evaluation import evaluate
from codrl_mj.runs.policies import load_policy
from codrl_mj.training import EVALUATION_SEED, TrainConfig, train


def motor(volts: float, delay: float = 0.0) -> dict[str, Any]:
    """Arguments of an environment whose motor has a supply [V], and commands that come late [s]."""
    return {
        "actuator": {"name": "default", "supply": {"voltage": volts}},
        "disturbances": {"command_delay": delay},
    }


TRAINED = {
    "ideal": {"actuator": "ideal"},
    "18 V": motor(18.0),
    "6 V": motor(6.0),
    "18 V, 6 ms": motor(18.0, 0.006),
}
TESTED = {f"{volts:g} V": motor(volts) for volts in (18.0, 12.0, 10.0, 8.0, 7.0, 6.0, 5.0)} | {
    f"18 V, {delay:g} ms": motor(18.0, delay / 1000.0) for delay in (2.0, 4.0, 6.0, 8.0, 10.0)
}


def main() -> None:
    """Train what is not trained, and evaluate all of it everywhere."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=30, help="of each policy on each motor")
    parser.add_argument("--total-steps", type=int, default=200_000)
    parser.add_argument(
        "--out", type=Path, default=Path("runs/furuta_table"), help="folder of the runs"
    )
    options = parser.parse_args()
    policies: dict[str, list[Any]] = {name: [] for name in TRAINED}
    for seed in range(options.seeds):
        for name, given in TRAINED.items():
            others = {key: value for key, value in given.items() if key != "actuator"}
            changes: dict[str, Any] = {"seed": seed, "total_steps": options.total_steps}
            config = TrainConfig.preset(
                "furuta", "ppo", "default", given["actuator"], others, **changes
            )
            run = options.out / f"{name.replace(', ', '_').replace(' ', '')}-{seed}"
            policies[name].append(
                load_policy(train(config, run, resume=True, accept_changes=True, tensorboard=False))
            )
    print(
        "| run on | "
        + " | ".join(f"trained {'on' if name == 'ideal' else 'at'} {name}" for name in TRAINED)
        + " |"
    )
    print("| --- |" + " ---: |" * len(TRAINED))
    for condition, given in TESTED.items():
        cells = []
        for ones in policies.values():
            found = [
                evaluate(
                    one, EnvConfig("furuta", **given), options.episodes, EVALUATION_SEED
                ).returns.mean
                for one in ones
            ]
            cells.append(f"{sum(found) / len(found):.0f} ({min(found):.0f} to {max(found):.0f})")
        print(f"| {condition} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
