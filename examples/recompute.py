"""The study's main numbers from its published rows alone: no package of ours, only csv and statistics."""

import csv
import statistics
import sys
from pathlib import Path

path = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/results/actuators/runs.csv")
rows = list(csv.DictReader(path.read_text().splitlines()))
scores: dict[tuple[str, str, str], list[float]] = {}
for row in rows:
    scores.setdefault((row["task"], row["trained"], row["tested"]), []).append(float(row["score"]))

DOSES = {
    "pendulum": ("lag 2", "weakness 0.25", "supply 0.35", "delay 2", "friction 0.1", "noise 0.8"),
    "furuta": ("lag 0.5", "weakness 0.55", "supply 0.6", "delay 0.5", "friction 0.2", "noise 0.8"),
}
print(
    f"{'task':10}{'tested on':16}{'trained on: ideal':>20}{'random':>20}{'it':>20}   (mean score;"
    " of 20, how many fail)"
)
for task, doses in DOSES.items():
    for dose in doses:
        cells = [scores[task, trained, dose] for trained in ("ideal", "generic", dose.split()[0])]
        shown = [
            f"{statistics.mean(each):.3f}; {sum(one < 0.9 for one in each):2}" for each in cells
        ]
        print(f"{task:10}{dose:16}" + "".join(f"{one:>20}" for one in shown))
