"""Entry point of `python -m codrl_mj`, the command line."""

import sys

from codrl_mj.cli import main

if __name__ == "__main__":
    sys.exit(main())
