"""Check a lab's calibration and say what it means: `python -m i2t.hardware.rig --help`."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

import i2t.hardware.rig
from i2t.cli import exit_code_of, read_options
from i2t.hardware.rig import Rig, summary
from i2t.hardware.rig_checks import implausible


@dataclass(frozen=True)
class RigArgs:
    """Check a lab's calibration and say what it means."""

    file: tyro.conf.Positional[Path]  # the lab's calibration
    example: bool = False  # write that of the emulators, to start from


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Without the program's name; by default those of this process.

    Returns:
        The exit code.
    """
    about = i2t.hardware.rig.__doc__ or ""
    asked = read_options(RigArgs, arguments, program="python -m i2t.hardware.rig", description=about)
    return exit_code_of(lambda: _check(asked))


def _check(asked: RigArgs) -> int:
    if asked.example:
        if asked.file.exists():
            raise FileExistsError(f"{asked.file}: exists already; give another name")
        Rig().write(asked.file)
    rig = Rig.read(asked.file)
    print(summary(rig))
    doubts = implausible(rig)
    for doubt in doubts:
        print(f"DOUBT     {doubt}")
    return int(bool(doubts))


if __name__ == "__main__":
    sys.exit(main())
