"""Compare Furuta policies on weaker supplies and with delays, trained on ideal forces and motors.

Prints a table of the mean return over the seeds, with the worst and the best seed's. Finished runs
are not trained again; three seeds take half an hour on one core.
"""

import argparse
from pathlib import Path
from typing import Any

from codrl_mj import EnvConfig
from codrl_mj.evaluation import evaluate
from codrl_mj.runs.policies import load_policy
from codrl_mj.training import EVALUATION_SEED, TrainConfig, train


def motor(volts: float, delay: float = 0.0) -> dict[str, Any]:
    """Return arguments of an environment whose motor has a supply [V] and delayed commands [s]."""
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
    """Train the missing policies, and evaluate each policy on each motor."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=30, help="episodes per policy and motor")
    parser.add_argument("--total-steps", type=int, default=200_000)
    parser.add_argument(
        "--out", type=Path, default=Path("runs/furuta_table"), help="folder of the runs"
    )
    options = parser.parse_args()
    policies: dict[str, list[Any]] = {name: [] for name in TRAINED}
    for seed in range(options.seeds):
        # All policies are trained before the first row, which needs every one.
        for name, arguments in TRAINED.items():
            others = {key: value for key, value in arguments.items() if key != "actuator"}
            changes: dict[str, Any] = {"seed": seed, "total_steps": options.total_steps}
            config = TrainConfig.preset(
                "furuta", "ppo", "default", arguments["actuator"], others, **changes
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
    for condition, arguments in TESTED.items():
        cells = []
        for seed_policies in policies.values():
            returns = [
                evaluate(
                    policy, EnvConfig("furuta", **arguments), options.episodes, EVALUATION_SEED
                ).returns.mean
                for policy in seed_policies
            ]
            cells.append(
                f"{sum(returns) / len(returns):.0f} ({min(returns):.0f} to {max(returns):.0f})"
            )
        print(f"| {condition} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
