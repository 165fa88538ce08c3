"""Recompute the study's main numbers from its published rows, without this package."""

import csv
import statistics
import sys
from pathlib import Path

path = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/results/actuators/runs.csv")
rows = list(csv.DictReader(path.read_text().splitlines()))
scores: dict[tuple[str, str, str], list[float]] = {}
for row in rows:
    scores.setdefault((row["task"], row["trained"], row["tested"]), []).append(float(row["score"]))

SEVERITIES = {
    "pendulum": ("lag 2", "weakness 0.25", "supply 0.35", "delay 2", "friction 0.1", "noise 0.8"),
    "furuta": ("lag 0.5", "weakness 0.55", "supply 0.6", "delay 0.5", "friction 0.2", "noise 0.8"),
}
print(
    f"{'task':10}{'tested on':16}{'trained on: ideal':>20}{'random':>20}{'it':>20}   (mean score;"
    " of 20, how many fail)"
)
for task, severities in SEVERITIES.items():
    for severity in severities:
        # An arm that was trained through an axis has its name, such as lag.
        cells = [
            scores[task, trained, severity] for trained in ("ideal", "generic", severity.split()[0])
        ]
        shown = [
            f"{statistics.mean(arm_scores):.3f}; {sum(score < 0.9 for score in arm_scores):2}"
            for arm_scores in cells
        ]
        print(f"{task:10}{severity:16}" + "".join(f"{cell:>20}" for cell in shown))
