"""`python -m experiments.tsne --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.tsne.arguments import TsneArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(TsneArgs, argv, "experiments.tsne.run")


if __name__ == "__main__":
    sys.exit(main())
