"""`python -m experiments.recognize --help`."""

import sys

from experiments.recognize.run import main

if __name__ == "__main__":
    sys.exit(main())
