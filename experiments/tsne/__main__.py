"""`python -m experiments.tsne --help`."""

import sys

from experiments.common.commands import command
from experiments.tsne.arguments import TsneArgs

main = command(TsneArgs, "experiments.tsne.run")

if __name__ == "__main__":
    sys.exit(main())
