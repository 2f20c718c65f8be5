"""`python -m experiments.calibrate_pads --help`."""

import sys
from collections.abc import Sequence

from experiments.calibrate_pads.arguments import CalibratePadsArgs
from experiments.common.commands import run_command


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(CalibratePadsArgs, argv, "experiments.calibrate_pads.run")


if __name__ == "__main__":
    sys.exit(main())
