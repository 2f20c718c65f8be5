"""`python -m experiments.faults --help`."""

import sys

from experiments.faults.run import main

if __name__ == "__main__":
    sys.exit(main())
