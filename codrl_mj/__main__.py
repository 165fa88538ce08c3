"""`python -m codrl_mj` is the command line."""

import sys

from codrl_mj.cli import main

if __name__ == "__main__":
    sys.exit(main())
