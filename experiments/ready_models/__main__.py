"""`python -m experiments.ready_models --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.ready_models.arguments import ReadyModelsArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(ReadyModelsArgs, argv, "experiments.ready_models.run")


if __name__ == "__main__":
    sys.exit(main())
