"""`python -m tests.faults --help`."""

import sys

from experiments.common.commands import command
from tests.faults.arguments import FaultsArgs

main = command(FaultsArgs, "tests.faults.run")

if __name__ == "__main__":
    sys.exit(main())
