"""The paper's experiments from Python: what `codrl-mj reproduce` does, without its progress bars.

Begins them or goes on with them, and writes their page: docs/reproduction.md.
"""

import argparse
import sys
from pathlib import Path

from codrl_mj.study.grid import Workers
from codrl_mj.study.reproduction.page import write
from codrl_mj.study.reproduction.reproduce import Reproduction, compute, gather


def main() -> int:
    """Train, test, judge and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", help="task names; all if none is named")
    parser.add_argument("--root", type=Path, default=Path("runs/paper"), help="folder of the run folders")
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder for the page")
    parser.add_argument("--seeds", type=int, default=5, help="training runs of each kind, but for SARSA")
    parser.add_argument("--jobs", type=int, default=-1, help="trainings at once; -1 for one on each CPU")
    options = parser.parse_args()

    plan = Reproduction(options.root, tuple(options.tasks) or Reproduction.tasks, options.seeds)
    compute(plan, Workers(options.jobs), on_cell=lambda kind: print(kind, flush=True))
    findings = gather(plan)
    for claim, verdict in findings.claims:
        print(f"{verdict.outcome}: {claim.task} ({claim.physics}): {claim.statement}: {verdict.reason}")
    for file in write(findings, options.out):
        print(f"wrote {file}")
    return 1 if any(series.failures for series in findings.evidence.series.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
