"""`python -m tests.second_world --help`."""

import sys

from experiments.common.commands import command
from tests.second_world.arguments import SecondWorldArgs

main = command(SecondWorldArgs, "tests.second_world.run")

if __name__ == "__main__":
    sys.exit(main())
