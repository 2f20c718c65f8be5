"""`python -m experiments.calibrate_pads --help`."""

import sys

from experiments.calibrate_pads.run import main

if __name__ == "__main__":
    sys.exit(main())
