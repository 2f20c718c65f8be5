"""The command `i2t`: `i2t imagine ...` runs a sub-command, and `i2t` alone lists them.

Only the module of the sub-command that was called is imported. --all also lists the experiments of a checkout,
--versions prints the versions that a bug report should contain, and --tyro-write-completion writes a script with which
a shell completes sub-commands and options.
"""

import os
import pkgutil
import platform
import re
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from i2t._version import __version__
from i2t.cli.exit_codes import CommandLine, exit_code_of
from i2t.cli.options import read_options
from i2t.cli.pipes import ExitCode
from i2t.errors import did_you_mean
from i2t.installation import DISTRIBUTION, checkout


class SubCommand(NamedTuple):
    """A sub-command: the module whose `main` it is, and the purpose that the list prints."""

    module: str
    purpose: str


# Sub-commands of i2t by their names.
COMMANDS = {
    "imagine": SubCommand("i2t.imagine", "predict and draw the readings of a skin on an object"),
    "collect": SubCommand("i2t.collect.command", "collect simulated or real touches"),
    "convert": SubCommand("i2t.convert.commands", "convert recordings to data sets, and back"),
    "fit": SubCommand("i2t.commands.fit", "fit a predictor and a pad model to a data set"),
    "recognize": SubCommand("i2t.commands.recognize", "recognise the objects of recorded sessions"),
    "view": SubCommand("i2t.view.command", "look at objects, touches and skins in the browser"),
    "place": SubCommand("i2t.place", "find the pose of an object with a camera"),
    "skin": SubCommand("i2t.hardware.reskin.monitor", "show and record the readings of a skin"),
    "rig": SubCommand("i2t.hardware.rig.__main__", "write and check the calibration file of a lab"),
    "hand-eye": SubCommand("i2t.hardware.hand_eye", "find the pose of the camera on the arm"),
    "touch-off": SubCommand("i2t.hardware.touch_off", "find the pose of the skin on the arm"),
    "camera": SubCommand("i2t.hardware.realsense", "show a depth camera and save its views"),
    "lab": SubCommand("i2t.emulators.lab", "emulate an arm and skins, with their protocols"),
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
    "experiments.reconstruct": "reconstruct shapes from one or many touches",
    "experiments.active_touch": "learn which site to touch next",
    "experiments.benchmark": "measure speeds and compare with other libraries",
}
FLAGS = ("--all", "--versions", "--help", "-h")
COMPLETION = "--tyro-write-completion"


def main(argv: Sequence[str] | None = None, *, program: str = "i2t") -> int:
    """Run a sub-command of i2t, or list them.

    Args:
        argv: The words after the program's name; by default, those of `sys.argv`.
        program: The program as the user typed it, `i2t` or `python -m i2t`.

    Returns:
        The exit code of the command.

    Raises:
        SystemExit: After the help, or after the script of completions is written.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if words and words[0] in COMMANDS:
        if os.getcwd() not in sys.path and not sys.flags.safe_path:
            sys.path.append(os.getcwd())  # where `python -m` finds a user's own devices (package.module:Class)
        return command_of(words[0])(words[1:], program=f"{program} {words[0]}")
    if words and words[0] == COMPLETION:
        return exit_code_of(lambda: _write_completion(words))
    if words and (words[0] not in FLAGS or len(words) > 1):
        print(f"error: {_explain_wrong(words, program)}", file=sys.stderr)
        return ExitCode.WRONG_USE
    if words == ["--versions"]:
        return exit_code_of(lambda: print(versions()))
    code = exit_code_of(lambda: _list(program, everything=words == ["--all"]))
    if words and words[0] in ("--help", "-h"):
        raise SystemExit(code)  # as all commands end after their help
    return code


def command_of(name: str) -> CommandLine:
    """Import a sub-command.

    Args:
        name: Name of the sub-command, one of `COMMANDS`.

    Returns:
        The sub-command, which is called with the words after its name.
    """
    command: CommandLine = pkgutil.resolve_name(f"{COMMANDS[name].module}:main")
    return command


def versions() -> str:
    """List the versions of i2t, Python, the operating system, and the installed packages that i2t requires.

    Returns:
        One line for each, with name and version.
    """
    lines = [f"i2t {__version__}", f"Python {platform.python_version()}", platform.platform()]
    required = {re.split(r"[^\w.-]", requirement)[0] for requirement in metadata.requires(DISTRIBUTION) or ()}
    for name in sorted(required - {DISTRIBUTION}, key=str.lower):
        try:
            lines.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:  # of an extra
            continue
    return "\n".join(lines)


def _explain_wrong(words: list[str], program: str) -> str:
    """Explain what is wrong with words that are not a sub-command, and the remedy."""
    first, *others = words
    if first in FLAGS:
        return f"{first} takes no other words; leave out {' '.join(others)}"
    experiments = {name.rpartition(".")[2]: name for name in EXPERIMENTS if checkout()}
    if name := experiments.get(first.rpartition(".")[2]):
        return f"{first} is not a command of i2t but an experiment; run python -m {name}"
    usage = f"{program} lists the commands, and each has its own --help"
    return f"{first} is not a command; {did_you_mean(first, (*COMMANDS, *FLAGS, COMPLETION), usage)}"


def _write_completion(words: list[str]) -> None:
    """Write the script with which a shell completes the sub-commands and their options."""
    if len(words) != 3 or words[1] not in ("bash", "zsh"):
        raise ValueError(f"{COMPLETION} takes a shell and a file; give bash or zsh, and a file")
    import tyro

    Path(words[2]).parent.mkdir(parents=True, exist_ok=True)
    kinds: Any = None
    for name in COMMANDS:
        kind = Annotated[command_of(name).kind, tyro.conf.subcommand(name=name, description=COMMANDS[name].purpose)]
        kinds = kind if kinds is None else kinds | kind
    try:
        read_options(kinds, words, program="i2t")
    finally:  # tyro exits after it has written the script
        script = Path(words[2])
        if script.is_file():
            script.write_text(_with_files(script.read_text()))


def _with_files(script: str) -> str:
    """Change tyro's script, which completes sub-commands and options only, to complete files and known names too."""
    objects = pkgutil.resolve_name("i2t.objects.catalogue:NAMES")
    completions = {"imagine": objects, "fit": ("nominal",), "recognize": ("nominal",), "view": ("nominal",)}
    mark = "__TYRO_COMPLETE_FILES__"  # tyro's answer if the shell is to complete the name of a file
    changes = (
        (  # the Python part, for a word after the last sub-command that is no option
            "    # Generate completions.\n",
            '    if not current_word.startswith("-") and not current_spec.get("subcommands"):\n'
            f"        names = {completions!r}.get(words[0], ())\n"
            f'        return ["{mark}", *(name for name in names if name.startswith(current_word))]\n',
        ),
        (f'== "{mark}" ]]', f'== "{mark}"* ]]'),
        (  # of bash
            '    COMPREPLY=($(compgen -f -- "$cur"))\n',
            "    local IFS=$'\\n'\n"
            f'    COMPREPLY=(${{completions#{mark}}} $(compgen -f -- "${{COMP_WORDS[COMP_CWORD]}}"))\n'
            "    compopt -o filenames 2>/dev/null\n",
        ),
        ("complete -F", "complete -o default -o bashdefault -F"),
        (  # of zsh
            "    _files\n",
            f"    local -a names=(${{(f)completions#{mark}}})\n    compadd -a names\n    _files\n",
        ),
    )
    for before, after in changes:
        script = script.replace(before, after)
    return script


def _list(program: str, *, everything: bool) -> None:
    commands = {f"{program} {name}": command.purpose for name, command in COMMANDS.items()}
    print(f"i2t {__version__}: imagine a touch before making it\n\n{_table(commands)}")
    if everything and checkout():
        experiments = {f"python -m {name}": purpose for name, purpose in EXPERIMENTS.items()}
        print(f"\nexperiments, which run in a checkout of the repository:\n\n{_table(experiments)}")
    print(
        f"\nEach has its own --help. Try {program} imagine first, then {program} collect, which can simulate the lab."
    )
    if checkout() and not everything:
        print("--all also lists the experiments of this checkout.")
    print(f"--versions lists the versions for a bug report. {COMPLETION} bash FILE writes shell completions.")


def _table(commands: dict[str, str]) -> str:
    """Write a line for each command."""
    width = max(map(len, commands)) + 4
    return "\n".join(name.ljust(width) + purpose for name, purpose in commands.items())
