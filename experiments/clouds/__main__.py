"""`python -m experiments.clouds --help`."""

import sys
from collections.abc import Sequence

from experiments.clouds.arguments import CloudArgs
from experiments.common.commands import run_command


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(CloudArgs, argv, "experiments.clouds.run")


if __name__ == "__main__":
    sys.exit(main())
