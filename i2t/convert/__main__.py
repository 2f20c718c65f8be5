"""Convert recordings: `i2t convert --help`."""

import sys

from i2t.convert.commands import main

if __name__ == "__main__":
    sys.exit(main())
