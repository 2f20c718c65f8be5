"""`python -m experiments.shapes --help`."""

import sys

from experiments.common.commands import command
from experiments.shapes.arguments import ShapesArgs

main = command(ShapesArgs, "experiments.shapes.run")

if __name__ == "__main__":
    sys.exit(main())
