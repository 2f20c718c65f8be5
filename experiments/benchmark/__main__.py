"""`python -m experiments.benchmark --help`."""

import sys

import tyro

from experiments.benchmark import run
from experiments.benchmark.timing import MissingPeerError

if __name__ == "__main__":
    try:
        run.main(tyro.cli(run.Benchmark, prog="python -m experiments.benchmark", description=run.__doc__))
    except (MissingPeerError, ValueError) as error:
        sys.exit(str(error))
