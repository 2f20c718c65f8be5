"""`python -m experiments.reconstruct --help`, and `patch --help` and `tip --help` of its other parts."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_part
from experiments.reconstruct.arguments import PatchArgs, ReconstructArgs, TipArgs

PARTS = {
    "surface": (ReconstructArgs, "experiments.reconstruct.surface"),
    "patch": (PatchArgs, "experiments.reconstruct.patch"),
    "tip": (TipArgs, "experiments.reconstruct.tip"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_part(PARTS, argv, "experiments.reconstruct")


if __name__ == "__main__":
    sys.exit(main())
