"""`python -m experiments.refine --help`."""

import sys

from experiments.refine.run import main

if __name__ == "__main__":
    sys.exit(main())
