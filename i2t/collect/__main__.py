"""Collect touches: `i2t collect --help`."""

import sys

from i2t.collect.command import main

if __name__ == "__main__":
    sys.exit(main())
