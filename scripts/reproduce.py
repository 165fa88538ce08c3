"""The paper's experiments done again: the trainings behind docs/results/reproduction.md.

python scripts/reproduce.py --dry-run
"""

import sys

from codrl_mj.study.program import main
from reproduction.study import Reproduction

if __name__ == "__main__":
    sys.exit(main(Reproduction))
