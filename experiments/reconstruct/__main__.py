"""`python -m experiments.reconstruct --help`, and `python -m experiments.reconstruct patch --help`."""

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
