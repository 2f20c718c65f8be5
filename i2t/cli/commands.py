"""List the commands: `python -m i2t` lists the most common ones, and --all lists all. --versions prints the versions
that a bug report should contain.

Experiments are not installed; they are listed if the checkout exists.
"""

import platform
import re
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from i2t._version import __version__
from i2t.cli.exit_codes import exit_code_of
from i2t.cli.pipes import ExitCode
from i2t.errors import did_you_mean

# Modules of the library that run with python -m, with the purpose that the list of commands prints.
COMMANDS = {
    "i2t.imagine": "predict and draw the readings of a skin on an object",
    "i2t.collect": "collect simulated or real touches",
    "i2t.convert": "convert recordings to data sets, and back",
    "i2t.commands.fit": "fit a predictor and a pad model to a data set",
    "i2t.commands.recognize": "recognise the objects of recorded sessions",
    "i2t.view": "show recordings as a page and in Rerun",
    "i2t.place": "find the pose of an object with a camera",
    "i2t.hardware.reskin": "show and record the readings of a skin",
    "i2t.hardware.rig": "write and check the calibration file of a lab",
    "i2t.hardware.hand_eye": "find the pose of the camera on the arm",
    "i2t.hardware.touch_off": "find the pose of the skin on the arm",
    "i2t.hardware.realsense": "show a depth camera and save its views",
    "i2t.emulators.lab": "emulate an arm and skins, with their protocols",
}
# Modules of the checkout that run with python -m and are not installed, with their purposes.
EXPERIMENTS = {
    "experiments.train": "train a predictor of readings",
    "experiments.recognize": "recognise objects by touch",
    "experiments.studies": "measure what recognition depends on",
    "experiments.calibrate": "find how many presses a calibration needs",
    "experiments.fidelity": "measure the quality of a recording of a skin",
    "experiments.shapes": "classify which of five stamps was pressed",
    "experiments.tsne": "compare the clusters of views and of readings",
    "experiments.registration": "compare patches of real depth images with rendered ones",
    "tools.gallery": "draw the figures of the documentation",
    "tools.ready_models": "train the models that come with the package",
    "tools.notebooks": "convert notebooks to HTML",
    "experiments.reconstruct": "reconstruct shapes from one or many touches",
    "experiments.active_touch": "learn which site to touch next",
    "experiments.benchmark": "measure speeds and compare with other libraries",
    "tests.faults": "inject faults into collections and count what is lost",
    "tests.second_world": "compare predictors under physics that i2t does not model",
    "tools.check_docs": "check the documentation",
    "tools.reproduce": "repeat the studies and tables of the documentation",
}
# The most common commands, which are listed by default.
COMMON_COMMANDS = (
    "i2t.imagine", "i2t.collect", "i2t.convert", "i2t.view", "i2t.hardware.reskin", "i2t.hardware.rig",
    "experiments.train", "experiments.recognize", "experiments.calibrate", "experiments.fidelity",
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run `python -m i2t`, which lists the commands of i2t.

    Args:
        argv: The words after the program's name; only --all, --versions and --help are allowed.

    Returns:
        The exit code of the command.

    Raises:
        SystemExit: After the help.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    help_requested = words in (["--help"], ["-h"])
    everything = words == ["--all"]
    if words == ["--versions"]:
        return exit_code_of(lambda: print(versions()))
    if words and not help_requested and not everything:
        usage = "python -m i2t lists the commands, and each has its own --help"
        remedy = did_you_mean(words[0], (*COMMANDS, *EXPERIMENTS), usage)
        print(f"error: {' '.join(words)} is not a command; {remedy}", file=sys.stderr)
        return ExitCode.WRONG_USE
    code = exit_code_of(lambda: _list(everything))
    if help_requested:
        raise SystemExit(code)  # as all commands end after their help
    return code


def versions() -> str:
    """List the versions of i2t, Python, the operating system, and the installed packages that i2t requires.

    Returns:
        One line for each, with name and version.
    """
    lines = [f"i2t {__version__}", f"Python {platform.python_version()}", platform.platform()]
    distribution = "imagine2touch"
    required = {re.split(r"[^\w.-]", requirement)[0] for requirement in metadata.requires(distribution) or ()}
    for name in sorted(required - {distribution}, key=str.lower):
        try:
            lines.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:  # of an extra
            continue
    return "\n".join(lines)


def _list(everything: bool) -> None:
    library, experiments = (
        {name: purpose for name, purpose in commands.items() if everything or name in COMMON_COMMANDS}
        for commands in (COMMANDS, EXPERIMENTS)
    )
    print(f"i2t {__version__}: imagine a touch before making it\n\n{_table(library)}")
    if (Path(__file__).parents[2] / "experiments").is_dir():
        print(f"\nin a checkout of the repository:\n\n{_table(experiments)}")
    print("\nEach has its own --help. Try python -m i2t.imagine first, then i2t.collect, which can simulate the lab.")
    if not everything:
        print(f"--all lists all {len(COMMANDS) + len(EXPERIMENTS)}, --versions lists the versions for a bug report.")


def _table(commands: dict[str, str]) -> str:
    """Write a line for each command."""
    return "\n".join(f"python -m {name}".ljust(40) + purpose for name, purpose in commands.items())
