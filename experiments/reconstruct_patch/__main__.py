"""`python -m experiments.reconstruct_patch --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.reconstruct_patch.arguments import PatchArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(PatchArgs, argv, "experiments.reconstruct_patch.run")


if __name__ == "__main__":
    sys.exit(main())
