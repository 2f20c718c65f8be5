"""`python -m experiments.calibrate --help`."""

import sys

from experiments.calibrate.arguments import CalibrateArgs
from experiments.common.commands import command

main = command(CalibrateArgs, "experiments.calibrate.run")

if __name__ == "__main__":
    sys.exit(main())
