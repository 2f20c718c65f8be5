"""`python -m experiments.unknowns --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.unknowns.arguments import UnknownsArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(UnknownsArgs, argv, "experiments.unknowns.run")


if __name__ == "__main__":
    sys.exit(main())
