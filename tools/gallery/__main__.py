"""`python -m tools.gallery --help`."""

import sys

from experiments.common.commands import command
from tools.gallery.arguments import GalleryArgs

main = command(GalleryArgs, "tools.gallery.run")

if __name__ == "__main__":
    sys.exit(main())
