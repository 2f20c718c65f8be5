"""`python -m i2t`."""

import sys

from i2t.cli.commands import main

if __name__ == "__main__":
    sys.exit(main())
