"""`python -m experiments.shapes --help`."""

import sys

from experiments.shapes.run import main

if __name__ == "__main__":
    sys.exit(main())
