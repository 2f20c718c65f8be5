"""`python -m experiments.fidelity --help`."""

import sys

from experiments.common.commands import command
from experiments.fidelity.arguments import FidelityArgs

main = command(FidelityArgs, "experiments.fidelity.run")

if __name__ == "__main__":
    sys.exit(main())
