"""Find the object: `python -m i2t.place`, kept as a short name of `i2t.collect.place`."""

import sys

from i2t.collect.place import main

if __name__ == "__main__":
    sys.exit(main())
