"""Cross-validate codrl_mj: the mechanics with Gymnasium's, the motor with other libraries' motors.

Example: python scripts/cross_validate.py cartpole --quick
"""

import argparse
import sys

from codrl_mj.validation import validate


def main() -> int:
    """Print every check with its worst case; return 1 if one failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", help="all tasks if none is named")
    parser.add_argument("--quick", action="store_true", help="fewer states, runs and step sizes")
    options = parser.parse_args()

    certificate = validate(options.tasks, quick=options.quick)
    for check in certificate.checks:
        verdict = "passed" if check.passed else "FAILED"
        print(
            f"{verdict}  {check.task or 'motor':24} {check.name:55} {check.worst:9.2g} of"
            f" {check.tolerance:g}"
        )
    return 0 if certificate.passed else 1


if __name__ == "__main__":
    sys.exit(main())
