"""Measure Pendulum's success under other tolerances of "upright and still".

Uses the policies and the test episodes of the study. Writes docs/upright_tolerances.csv, and prints
it as the table of docs/evaluation.md. The study's run folders must exist: python
scripts/study_actuators.py
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from actuator_study.study import ActuatorStudy
from codrl_mj.evaluation.episodes import run_episodes
from codrl_mj.runs.policies import load_policy
from codrl_mj.study.pages import write_csv
from codrl_mj.tasks import find_task
from codrl_mj.tasks.pendulum import GOAL_HOLD, upright_angle
from codrl_mj.training import finished

TOLERANCES = ((0.05, 0.05), (0.1, 0.1), (0.2, 0.1), (0.1, 0.2), (0.2, 0.5), (0.5, 1.0))
"""Pairs of angle [rad] and speed [rad/s]."""
TRIALS = (
    *(
        "ideal on ideal",
        "ideal on paper",
        "paper on paper",
        "ideal on designed",
        "ideal on noise 0.8",
    ),
    *(
        "noise on noise 0.8",
        "ideal on friction 0.1",
        "friction on friction 0.1",
        "ideal on lag 2",
        "lag on lag 2",
    ),
    *("weakness on weakness 0.25", "marginal motor on marginal motor", "weaker on weaker"),
)
"""Names of trials: trained on, and tested on."""


def row(name: str, study: ActuatorStudy) -> dict[str, object]:
    """Return the share of a trial's episodes that end upright and still, by tolerance."""
    step = find_task("pendulum").step_duration
    num_held = round(GOAL_HOLD / step) + 1
    worst: list[np.ndarray] = []
    tests = study.grid.policy_tests
    policies = [tests[f"pendulum: {name}", seed] for seed in range(study.seeds)]
    policies = [test for test in policies if finished(test.run)]
    for test in policies:
        for episode in run_episodes(
            load_policy(test.run), test.env.build, test.episodes, test.seed
        ):
            end = episode.state[-num_held:]
            worst.append(np.array([np.abs(upright_angle(end.T)).max(), np.abs(end[:, 1]).max()]))
    reached = np.array(worst).reshape(-1, 2)
    shares = {
        f"{angle:g} rad, {speed:g} rad/s": round(
            float(np.mean((reached < (angle, speed)).all(axis=1))), 3
        )
        for angle, speed in TOLERANCES
    }
    return {"policies": name, "seeds": len(policies), **shares}


def main() -> int:
    """Write the file and print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--root",
        type=Path,
        default=Path("runs/actuators"),
        help="folder of the study's run folders",
    )
    parser.add_argument(
        "--out", type=Path, default=Path("docs/upright_tolerances.csv"), help="file of the table"
    )
    options = parser.parse_args()
    study = ActuatorStudy(root=options.root, tasks=("pendulum",))
    rows = [table_row for name in TRIALS if (table_row := row(name, study))["seeds"]]
    if not rows:
        print(
            f"no finished training in {options.root}: run python scripts/study_actuators.py first",
            file=sys.stderr,
        )
        return 1
    write_csv(options.out, rows)
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(table_row.values() for table_row in rows)]
    print("\n".join(f"| {' | '.join(map(str, line))} |" for line in lines))
    print(f"wrote {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
