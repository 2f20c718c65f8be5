"""Watch, record or list boards: `i2t skin --help`."""

import sys

from i2t.hardware.reskin.monitor import main

if __name__ == "__main__":
    sys.exit(main())
