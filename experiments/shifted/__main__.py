"""`python -m experiments.shifted --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.shifted.arguments import ShiftedArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(ShiftedArgs, argv, "experiments.shifted.run")


if __name__ == "__main__":
    sys.exit(main())
