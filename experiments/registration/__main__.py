"""`python -m experiments.registration frames --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_part
from experiments.registration.arguments import FramesArgs

PARTS = {"frames": (FramesArgs, "experiments.registration.frames")}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_part(PARTS, argv, "experiments.registration")


if __name__ == "__main__":
    sys.exit(main())
