"""`python -m experiments.calibrate --help`."""

import sys
from collections.abc import Sequence

from experiments.calibrate.arguments import CalibrateArgs
from experiments.common.commands import run_command


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(CalibrateArgs, argv, "experiments.calibrate.run")


if __name__ == "__main__":
    sys.exit(main())
