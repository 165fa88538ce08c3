"""Study of protecting a policy from unmeasured actuators, behind docs/results/insurance.md.

Example: python scripts/study_insurance.py --dry-run
"""

import sys

from codrl_mj.study.program import main
from insurance_study.study import InsuranceStudy

if __name__ == "__main__":
    sys.exit(main(InsuranceStudy))
