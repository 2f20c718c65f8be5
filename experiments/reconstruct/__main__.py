"""`python -m experiments.reconstruct --help`, and `patch --help` and `tip --help` of its other parts."""

import sys

from experiments.common.commands import command_of_parts
from experiments.reconstruct.arguments import PatchArgs, ReconstructArgs, TipArgs

main = command_of_parts(
    "experiments.reconstruct",
    {
        "surface": (ReconstructArgs, "experiments.reconstruct.surface"),
        "patch": (PatchArgs, "experiments.reconstruct.patch"),
        "tip": (TipArgs, "experiments.reconstruct.tip"),
    },
)

if __name__ == "__main__":
    sys.exit(main())
