"""The mismatch study from Python: what `codrl-mj study mismatch` does, without its progress bars.

Begins the study or goes on with it, and writes its page: docs/studies.md.
"""

import argparse
import sys
from pathlib import Path

from codrl_mj.study.grid import Workers
from codrl_mj.study.mismatch import MismatchConfig, collect, compute
from codrl_mj.study.page import write


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path("runs/mismatch"), help="folder of the run folders")
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder for the page")
    parser.add_argument("--seeds", type=int, default=5, help="training runs of each kind")
    parser.add_argument("--jobs", type=int, default=-1, help="trainings at once; -1 for one on each CPU")
    options = parser.parse_args()

    config = MismatchConfig(options.root, seeds=options.seeds)
    compute(config, Workers(options.jobs), on_cell=lambda kind, name: print(f"{kind}: {name}", flush=True))
    results = collect(config)
    for file in write(results, options.out):
        print(f"wrote {file}")
    return 1 if results.failures else 0


if __name__ == "__main__":
    sys.exit(main())
