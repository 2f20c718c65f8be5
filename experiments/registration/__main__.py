"""`python -m experiments.registration patch --help` and `python -m experiments.registration frames --help`."""

import sys

from experiments.common.commands import command_of_parts
from experiments.registration.arguments import FramesArgs, PatchPoseArgs

main = command_of_parts(
    "experiments.registration",
    {
        "patch": (PatchPoseArgs, "experiments.registration.patch"),
        "frames": (FramesArgs, "experiments.registration.frames"),
    },
)

if __name__ == "__main__":
    sys.exit(main())
