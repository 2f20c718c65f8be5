"""Check a lab's calibration and explain what it means: `i2t rig --help`."""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

import i2t.hardware.rig
from i2t.cli.exit_codes import command
from i2t.hardware.rig import Rig, summary
from i2t.hardware.rig_checks import implausible_values


@dataclass(frozen=True)
class RigArgs:
    """Check a lab's calibration and explain what it means."""

    file: tyro.conf.Positional[Path]  # the lab's calibration file
    example: bool = False  # write the emulated lab's calibration as a new file to start from


def _check(args: RigArgs) -> int:
    if args.example:
        if args.file.exists():
            raise FileExistsError(f"{args.file}: exists already; give another name")
        Rig().write(args.file)
    rig = Rig.read(args.file)
    print(summary(rig))
    doubts = implausible_values(rig)
    for doubt in doubts:
        print(f"DOUBT     {doubt}")
    return int(bool(doubts))


main = command(RigArgs, _check, program="python -m i2t.hardware.rig", description=i2t.hardware.rig.__doc__)


if __name__ == "__main__":
    sys.exit(main())
