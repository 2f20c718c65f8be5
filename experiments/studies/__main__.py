"""`python -m experiments.studies --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.studies.arguments import StudyArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(StudyArgs, argv, "experiments.studies.run")


if __name__ == "__main__":
    sys.exit(main())
