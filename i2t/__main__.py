"""`python -m i2t`, which is the command `i2t`."""

import sys

from i2t.cli.commands import main

if __name__ == "__main__":
    sys.exit(main(program="python -m i2t"))
