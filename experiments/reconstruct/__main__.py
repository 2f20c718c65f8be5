"""`python -m experiments.reconstruct --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.reconstruct.arguments import ReconstructArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(ReconstructArgs, argv, "experiments.reconstruct.run")


if __name__ == "__main__":
    sys.exit(main())
