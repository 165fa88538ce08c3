"""Train third-party environments through chosen and smaller motors, and compare the returns.

An agent learns each environment on ideal actuators. Motors are chosen for the demands of the first
seed's policy; smaller ones are the strongest that lack something. Agents then learn through both,
and every policy is tested on all three. Interrupted trainings are resumed. Writes
docs/worked_examples.csv, and its means into docs/worked_examples.md; `--steps 0.01` is a quick
trial.
"""

import argparse
import csv
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import yaml

ROOT = Path(__file__).parents[1]
# servo_arm is in this folder.
sys.path.insert(0, str(ROOT / "examples"))

from codrl_mj.evaluation import evaluate  # noqa: E402
from codrl_mj.runs.files import atomic_write  # noqa: E402
from codrl_mj.runs.policies import load_policy  # noqa: E402
from codrl_mj.sizing import Candidate, actuators_of, choose, demands_of  # noqa: E402
from codrl_mj.training import TrainConfig, train  # noqa: E402

SAC: dict[str, Any] = {
    "hidden": [64, 64],
    "batch_size": 128,
    "learning_starts": 2000,
    "learning_rate": 1e-3,
}
EXAMPLES: dict[str, tuple[str, int]] = {
    # Name -> environment id, and environment steps of a training.
    "double pendulum": ("InvertedDoublePendulum-v5", 15_000),
    "cheetah": ("HalfCheetah-v5", 20_000),
    "servo arm": ("servo_arm:ServoArm-v0", 15_000),
}
WRITTEN = "<!-- written by scripts/worked_examples.py -->"
"""Mark on the page, after which the script writes."""
THROUGH = ("ideal", "chosen", "smaller")
EPISODES, TEST_SEED = 20, 2_000_000
COLUMNS = (
    "environment",
    "trained through",
    "seed",
    "tested on",
    "return",
    "saturated %",
    "heat J",
    "success",
)


def main() -> None:
    """Train, choose motors, train through them, test, and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--runs", type=Path, default=ROOT / "runs" / "worked_examples", help="folder for the runs"
    )
    parser.add_argument(
        "--out", type=Path, default=ROOT / "docs", help="folder for worked_examples.csv"
    )
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each kind")
    parser.add_argument("--steps", type=float, default=1.0, help="share of the environment steps")
    parser.add_argument(
        "--only", nargs="*", choices=EXAMPLES, default=list(EXAMPLES), help="environments"
    )
    parser.add_argument(
        "--only-page", action="store_true", help="write the page from worked_examples.csv"
    )
    options = parser.parse_args()
    published = options.out / "worked_examples.csv"
    if options.only_page:
        with published.open(newline="") as file:
            rows: list[dict[str, Any]] = list(csv.DictReader(file))
    else:
        rows = _computed(options)
        with atomic_write(published) as temporary, temporary.open("w", newline="") as file:
            table = csv.DictWriter(file, COLUMNS)
            table.writeheader()
            table.writerows(rows)
    page = published.with_suffix(".md")
    if page.is_file():
        above = page.read_text().partition(WRITTEN)[0]
        page.write_text(f"{above}{WRITTEN}\n\n{_table(rows)}\n")
    print(_table(rows))


def _computed(options: Any) -> list[dict[str, Any]]:
    """Run the environments, and return the rows of all finished ones."""
    for name in options.only:
        _example(name, options)
    rows = [
        row
        for path in sorted(options.runs.glob("*/tests.json"))
        for row in json.loads(path.read_text())
    ]
    order = list(EXAMPLES)
    return sorted(rows, key=lambda row: order.index(row["environment"]))


def _example(name: str, options: Any) -> None:
    """Run one environment; finished tests are not repeated."""
    folder, (env_id, steps) = options.runs / name.replace(" ", "_"), EXAMPLES[name]
    if (folder / "tests.json").exists():
        return
    budget = max(300, int(options.steps * steps))

    def run(through: str, seed: int, actuators: Any) -> Path:
        agent = {**SAC, "learning_starts": min(SAC["learning_starts"], budget // 3), "name": "sac"}
        config = TrainConfig.from_mapping(
            {
                "env": {"task": env_id, "actuator": actuators},
                "agent": agent,
                "seed": seed,
                "total_steps": budget,
                "checkpoint_interval": 5000,
                "evaluation_interval": budget,
                "evaluation_episodes": 5,
            }
        )
        return train(config, folder / f"{through}-{seed}", resume=True, tensorboard=False)

    ideal = {".*": "ideal"}
    runs = {("ideal", seed): run("ideal", seed, ideal) for seed in range(options.seeds)}
    motors = {"ideal": ideal, **_motors(folder, runs["ideal", 0])}
    for through in THROUGH[1:]:
        runs |= {
            (through, seed): run(through, seed, motors[through]) for seed in range(options.seeds)
        }
    rows = []
    for (through, seed), path in runs.items():
        config = TrainConfig.from_mapping(
            json.loads((path / "config.json").read_text())["train"], whole=True
        )
        for tested in THROUGH:
            env = dataclasses.replace(config.env, actuator=motors[tested])
            evaluation = evaluate(load_policy(path), env, EPISODES, TEST_SEED)
            success = "" if evaluation.success is None else evaluation.success.mean
            heat = "" if evaluation.copper_loss is None else round(evaluation.copper_loss.mean, 2)
            saturated = (
                ""
                if evaluation.saturated_percent is None
                else round(evaluation.saturated_percent, 2)
            )
            values = (
                name,
                through,
                seed,
                tested,
                round(evaluation.returns.mean, 3),
                saturated,
                heat,
                success,
            )
            rows.append(dict(zip(COLUMNS, values, strict=True)))
            print(*values, flush=True)
    with atomic_write(folder / "tests.json") as temporary:
        temporary.write_text(json.dumps(rows, indent=1))


def _motors(folder: Path, ideal: Path) -> dict[str, Any]:
    """Return the `chosen` and `smaller` motors by pattern, from YAML files that are made once.

    `--actuators` takes the same files.
    """
    files = {name: folder / f"{name}.yaml" for name in THROUGH[1:]}
    if not all(path.exists() for path in files.values()):
        choices: dict[str, dict[str, Any]] = {name: {} for name in files}
        for motor, demand in demands_of(ideal, episodes=5, trust=True).items():
            ranked = choose(demand)
            for name, choice in (("chosen", ranked[0]), ("smaller", _smaller(ranked))):
                choices[name][motor] = choice, demand
                verdict = choice.rejection_reason or "does it"
                print(
                    f"{motor} {name}: {choice.name}, gear {choice.ratio:.4g}, {choice.power:.0f} W:"
                    f" {verdict}"
                )
        for name, path in files.items():
            with atomic_write(path) as temporary:
                temporary.write_text(yaml.safe_dump(actuators_of(choices[name]), sort_keys=False))
    return {name: yaml.safe_load(path.read_text()) for name, path in files.items()}


def _smaller(ranked: list[Candidate]) -> Candidate:
    """Return the strongest motor that has less power than the first and clearly lacks something.

    It lacks a third of the voltage or the current.
    """
    weaker = [
        candidate
        for candidate in ranked[1:]
        if candidate.power < ranked[0].power and candidate.feasibility.margin < -1 / 3
    ]
    return max(weaker, key=lambda candidate: candidate.power) if weaker else ranked[-1]


def _table(rows: list[dict[str, Any]]) -> str:
    """Return Markdown with the mean return [min, max] over seeds, by training and test."""
    lines = [
        "| environment | trained through | on ideal | on the chosen | on the smaller |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name in dict.fromkeys(row["environment"] for row in rows):
        for through in THROUGH:
            cells = []
            for tested in THROUGH:
                key = (name, through, tested)
                matching_rows = [
                    row
                    for row in rows
                    if (row["environment"], row["trained through"], row["tested on"]) == key
                ]
                returns = [float(row["return"]) for row in matching_rows]
                cells.append(
                    f"{np.mean(returns):.1f} [{min(returns):.1f}, {max(returns):.1f}]"
                    if returns
                    else "–"
                )
            lines.append(f"| {name} | {through} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
