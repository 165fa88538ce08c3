"""Study of the cost of an actuator, behind docs/results/actuators.md and `codrl-mj advise`.

Example: python scripts/study_actuators.py --dry-run
"""

import sys

from actuator_study.study import ActuatorStudy
from codrl_mj.study.program import main

if __name__ == "__main__":
    sys.exit(main(ActuatorStudy))
