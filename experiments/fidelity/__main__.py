"""`python -m experiments.fidelity --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.fidelity.arguments import FidelityArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(FidelityArgs, argv, "experiments.fidelity.run")


if __name__ == "__main__":
    sys.exit(main())
