"""`python -m experiments.real_frames --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.real_frames.arguments import RealFrames

RENAMED_FRAME_FLAGS = {
    "--facing": "--min-cosine",
    "--hidden": "--max-occlusion-m",
    "--border": "--border-px",
    "--slack": "--extra-reach-m",
    "--least": "--min-share",
    "--f200-fill": "--f200-fill-m",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(RealFrames, argv, "experiments.real_frames.run", renamed=RENAMED_FRAME_FLAGS)


if __name__ == "__main__":
    sys.exit(main())
