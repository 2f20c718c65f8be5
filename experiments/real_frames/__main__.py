"""`python -m experiments.real_frames --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.real_frames.arguments import RealFrames


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(RealFrames, argv, "experiments.real_frames.run")


if __name__ == "__main__":
    sys.exit(main())
