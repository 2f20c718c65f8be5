"""`python -m experiments.calibrate --help`."""

import sys

from experiments.calibrate.run import main

if __name__ == "__main__":
    sys.exit(main())
