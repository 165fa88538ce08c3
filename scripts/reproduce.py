"""Repeat the paper's experiments: the trainings behind docs/results/reproduction.md.

Example: python scripts/reproduce.py --dry-run
"""

import sys

from codrl_mj.study.program import main
from reproduction.study import Reproduction

if __name__ == "__main__":
    sys.exit(main(Reproduction))
