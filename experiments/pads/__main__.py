"""`python -m experiments.pads --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.pads.arguments import PadsArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(PadsArgs, argv, "experiments.pads.run")


if __name__ == "__main__":
    sys.exit(main())
