"""List of commands: `python -m i2t` lists those that users begin with, and with --all the others too.

Those of the experiments are listed where the checkout is at hand; they are not installed.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from i2t._version import __version__
from i2t.cli.exit_codes import WRONG_USE, exit_code_of
from i2t.errors import did_you_mean

COMMANDS = {
    "i2t.imagine": "draw what a skin would feel of an object",
    "i2t.collect": "collect touches, simulated or real",
    "i2t.convert": "recordings into data sets, and back",
    "i2t.view": "look at what was recorded",
    "i2t.place": "find where an object stands, by a camera",
    "i2t.hardware.reskin": "show and record a skin",
    "i2t.hardware.rig": "write and check the file of a lab",
    "i2t.hardware.hand_eye": "find where the camera sits on the arm",
    "i2t.hardware.touch_off": "find where the skin sits on the arm",
    "i2t.hardware.realsense": "show a depth camera",
    "i2t.emulators.lab": "speak the protocols of an arm and a skin",
}
EXPERIMENTS = {
    "experiments.train": "train a predictor of touches",
    "experiments.recognize": "which object is it, by touch?",
    "experiments.studies": "what makes recognition better or worse?",
    "experiments.calibrate": "how many presses tell one skin?",
    "experiments.fidelity": "what is a recording of a skin worth?",
    "experiments.shapes": "which of five stamps was pressed?",
    "experiments.tsne": "do views and readings sort alike?",
    "experiments.registration": "patches of real depth images, and imagined",
    "tools.gallery": "the pictures of the documents",
    "tools.ready_models": "the models that come with the package",
    "tools.notebooks": "notebooks as HTML",
    "experiments.reconstruct": "shape from one touch, and from many",
    "experiments.active_touch": "which touch next? policies that learn",
    "experiments.benchmark": "speeds, next to a peer's",
    "tests.faults": "what is lost when something breaks?",
    "tests.second_world": "do predictors lead where the physics is another?",
    "tools.check_docs": "are the documents true?",
    "tools.reproduce": "the documents' studies and tables again",
}
FIRST = (  # what users begin with, in this order
    "i2t.imagine", "i2t.collect", "i2t.convert", "i2t.view", "i2t.hardware.reskin", "i2t.hardware.rig",
    "experiments.train", "experiments.recognize", "experiments.calibrate", "experiments.fidelity",
)  # fmt: skip
NAME_WIDTH = 40
USAGE = "python -m i2t lists the commands, and each has its own --help"


def main(argv: Sequence[str] | None = None) -> int:
    """List the commands.

    Args:
        argv: The command line without the program's name; only --all and --help are known.

    Returns:
        The exit code.

    Raises:
        SystemExit: It was asked for help, and gave it.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    asked = words in (["--help"], ["-h"])
    everything = words == ["--all"]
    if words and not asked and not everything:
        remedy = did_you_mean(words[0], (*COMMANDS, *EXPERIMENTS), USAGE)
        print(f"error: {' '.join(words)} is no command; {remedy}", file=sys.stderr)
        return WRONG_USE
    code = exit_code_of(lambda: _list(everything))
    if asked:
        raise SystemExit(code)  # as every other command ends that is asked for help
    return code


def _list(everything: bool) -> None:
    library, experiments = (
        {name: said for name, said in commands.items() if everything or name in FIRST}
        for commands in (COMMANDS, EXPERIMENTS)
    )
    print(f"i2t {__version__}: imagine a touch before making it\n\n{_table(library)}")
    if (Path(__file__).parents[2] / "experiments").is_dir():
        print(f"\nfrom the folder of the checkout:\n\n{_table(experiments)}")
    print("\nEach has its own --help. Try python -m i2t.imagine first, then i2t.collect: it simulates all.")
    if not everything:
        print(f"All {len(COMMANDS) + len(EXPERIMENTS)} are listed by: python -m i2t --all")


def _table(commands: dict[str, str]) -> str:
    """A line for each command."""
    return "\n".join(f"python -m {name}".ljust(NAME_WIDTH) + said for name, said in commands.items())
