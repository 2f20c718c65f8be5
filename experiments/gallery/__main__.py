"""`python -m experiments.gallery --help`."""

import sys

from experiments.common.commands import command
from experiments.gallery.arguments import GalleryArgs

main = command(GalleryArgs, "experiments.gallery.run")

if __name__ == "__main__":
    sys.exit(main())
