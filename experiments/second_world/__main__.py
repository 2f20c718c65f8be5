"""`python -m experiments.second_world --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.second_world.arguments import SecondWorldArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(SecondWorldArgs, argv, "experiments.second_world.run")


if __name__ == "__main__":
    sys.exit(main())
