"""`python -m experiments.faults --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.faults.arguments import FaultsArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code, 1 if a goal was missed."""
    return run_command(FaultsArgs, argv, "experiments.faults.run")


if __name__ == "__main__":
    sys.exit(main())
