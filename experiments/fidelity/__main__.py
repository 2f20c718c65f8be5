"""`python -m experiments.fidelity --help`."""

import sys

from experiments.fidelity.run import main

if __name__ == "__main__":
    sys.exit(main())
