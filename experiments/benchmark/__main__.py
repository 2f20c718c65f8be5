"""`python -m experiments.benchmark --help`."""

import sys

from experiments.benchmark.arguments import BenchmarkArgs
from experiments.common.commands import command

main = command(BenchmarkArgs, "experiments.benchmark.run")

if __name__ == "__main__":
    sys.exit(main())
