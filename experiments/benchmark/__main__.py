"""`python -m experiments.benchmark --help`."""

import sys
from collections.abc import Sequence

from experiments.benchmark.arguments import BenchmarkArgs
from experiments.common.commands import run_command


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(BenchmarkArgs, argv, "experiments.benchmark.run")


if __name__ == "__main__":
    sys.exit(main())
