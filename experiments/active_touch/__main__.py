"""`python -m experiments.active_touch --help`."""

import sys

from experiments.active_touch.arguments import ActiveTouchArgs
from experiments.common.commands import command

main = command(ActiveTouchArgs, "experiments.active_touch.run")

if __name__ == "__main__":
    sys.exit(main())
