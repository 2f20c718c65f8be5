"""Watch, record or list boards: `python -m i2t.hardware.reskin --help`."""

import sys

from i2t.hardware.reskin.monitor import main

if __name__ == "__main__":
    sys.exit(main())
