"""`python -m experiments.reconstruct --help`, and `patch --help` of its other part."""

import sys

from experiments.common.commands import command_of_parts
from experiments.reconstruct.arguments import PatchArgs, ReconstructArgs

main = command_of_parts(
    "experiments.reconstruct",
    {
        "surface": (ReconstructArgs, "experiments.reconstruct.surface"),
        "patch": (PatchArgs, "experiments.reconstruct.patch"),
    },
)

if __name__ == "__main__":
    sys.exit(main())
