"""`python -m experiments.active_touch --help`."""

import sys
from collections.abc import Sequence

from experiments.active_touch.arguments import ActiveTouchArgs
from experiments.common.commands import run_command


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(ActiveTouchArgs, argv, "experiments.active_touch.run")


if __name__ == "__main__":
    sys.exit(main())
