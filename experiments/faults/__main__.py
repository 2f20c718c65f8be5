"""`python -m experiments.faults --help`."""

import sys

from experiments.common.commands import command
from experiments.faults.arguments import FaultsArgs

main = command(FaultsArgs, "experiments.faults.run")

if __name__ == "__main__":
    sys.exit(main())
