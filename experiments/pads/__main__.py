"""`python -m experiments.pads --help`."""

import sys

from experiments.pads.run import main

if __name__ == "__main__":
    sys.exit(main())
