"""`python -m experiments.train --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import command
from experiments.train.arguments import TrainArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    with command(TrainArgs, argv, "experiments.train.run") as this:
        args = this.checked()
        this.run(args)
    return this.code


if __name__ == "__main__":
    sys.exit(main())
