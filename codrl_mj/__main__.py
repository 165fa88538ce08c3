"""Entry point of the command line, `codrl-mj` and `python -m codrl_mj`."""

import sys

from codrl_mj.requirements import missing_module_message


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, or print which package it needs and how to install it.

    Args:
        arguments: the command line without the program's name; None: that of the process.

    Returns:
        Exit status: see `codrl_mj.cli.main`.
    """
    try:
        from codrl_mj import cli
    except ModuleNotFoundError as error:
        print(f"codrl-mj: error: {missing_module_message(error)}", file=sys.stderr)
        return 2
    return cli.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
