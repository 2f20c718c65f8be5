"""`python -m experiments.benchmark --help`."""

import sys

from experiments.benchmark.run import main

if __name__ == "__main__":
    sys.exit(main())
