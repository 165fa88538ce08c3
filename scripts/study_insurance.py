"""What insures a policy against an actuator that nobody has measured? The study behind docs/results/insurance.md.

python scripts/study_insurance.py --dry-run
"""

import sys

from codrl_mj.study.program import main
from insurance_study.study import InsuranceStudy

if __name__ == "__main__":
    sys.exit(main(InsuranceStudy))
