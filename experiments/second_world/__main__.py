"""`python -m experiments.second_world --help`."""

import sys

from experiments.second_world.run import main

if __name__ == "__main__":
    sys.exit(main())
