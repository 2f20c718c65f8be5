"""`python -m experiments.train --help`."""

import sys

from experiments.common.commands import command
from experiments.train.arguments import TrainArgs

main = command(TrainArgs, "experiments.train.run")

if __name__ == "__main__":
    sys.exit(main())
