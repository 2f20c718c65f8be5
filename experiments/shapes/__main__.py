"""`python -m experiments.shapes --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.shapes.arguments import ShapesArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(ShapesArgs, argv, "experiments.shapes.run")


if __name__ == "__main__":
    sys.exit(main())
