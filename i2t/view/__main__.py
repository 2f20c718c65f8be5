"""`i2t view`."""

import sys

from i2t.view.command import main

if __name__ == "__main__":
    sys.exit(main())
