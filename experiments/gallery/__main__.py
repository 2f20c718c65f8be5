"""`python -m experiments.gallery --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.gallery.arguments import GalleryArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(GalleryArgs, argv, "experiments.gallery.run")


if __name__ == "__main__":
    sys.exit(main())
