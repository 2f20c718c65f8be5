"""`python -m experiments.refine --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.refine.arguments import RefineArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(RefineArgs, argv, "experiments.refine.run")


if __name__ == "__main__":
    sys.exit(main())
