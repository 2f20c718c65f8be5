"""The command `i2t` with its sub-commands, the other commands that installing puts on the path, and the experiments."""

import importlib
import platform
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from i2t import installation
from i2t.cli.commands import COMMANDS, EXPERIMENTS, main
from i2t.convert.commands import main as convert

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_every_experiment_is_listed_and_every_command_of_developers_is_in_contributing():
    commands = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__")
        for pattern in ("experiments/*/__main__.py", "tools/*/__main__.py", "tools/*.py", "tests/*/__main__.py")
        for path in ROOT.glob(pattern)
        if path.name != "__init__.py"
    }
    assert {name for name in commands if name.startswith("experiments.")} == set(EXPERIMENTS)
    contributing = (ROOT / "CONTRIBUTING.md").read_text()
    assert [name for name in commands - set(EXPERIMENTS) if f"`python -m {name}`" not in contributing] == []


def test_the_list_has_the_purpose_of_each_sub_command_and_on_request_of_each_experiment(capsys):
    sub_commands = [f"i2t {name} {command.purpose}" for name, command in COMMANDS.items()]
    experiments = [f"python -m {name} {purpose}" for name, purpose in EXPERIMENTS.items()]
    assert _listed(capsys) == sub_commands
    assert _listed(capsys, "--all") == sub_commands + experiments
    assert main([], program="python -m i2t") == 0
    assert "\npython -m i2t imagine " in capsys.readouterr().out


def test_a_wheel_lists_only_what_it_has(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(installation, "ROOT", tmp_path)
    for words in ([], ["--all"]):
        assert main(words) == 0
        printed = capsys.readouterr().out
        assert "experiment" not in printed
        assert "--all" not in printed
    assert main(["train"]) == 2
    assert capsys.readouterr().err.startswith("error: train is not a command; i2t lists the commands")


def _listed(capsys, *words):
    """The lines of the list with single spaces, without the sentences around it."""
    assert main(words) == 0
    _, *parts = capsys.readouterr().out.split("\n\n")
    tables = [part for part in parts if part.startswith(("i2t ", "python -m "))]
    return [" ".join(line.split()) for table in tables for line in table.splitlines()]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("imagne mug.stl", "imagne is not a command; did you mean imagine?"),
        ("hand_eye", "hand_eye is not a command; did you mean hand-eye?"),
        ("--version", "--version is not a command; did you mean --versions?"),
        ("--all of them", "--all takes no other words; leave out of them"),
        ("train", "train is not a command of i2t but an experiment; run python -m experiments.train"),
        ("experiments.studies", "experiments.studies is not a command of i2t but an experiment; "),
        ("nothing", "nothing is not a command; i2t lists the commands, and each has its own --help"),
        ("--tyro-write-completion bash", "--tyro-write-completion takes a shell and a file; "),
        ("--tyro-write-completion csh file", "--tyro-write-completion takes a shell and a file; give bash or zsh"),
    ],
)
def test_a_wrong_word_is_answered_with_the_right_one(words, sentence, capsys):
    assert main(words.split()) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(f"error: {sentence}")
    assert printed.err.count("\n") == 1


def test_a_sub_command_ends_as_its_module_does_and_has_the_name_by_which_it_was_called(capsys):
    for words in (["summary", "nowhere"], ["summary"], ["nothing"]):
        ended = []
        for run in (lambda words=words: main(["convert", *words]), lambda words=words: convert(words)):
            try:
                code = run()
            except SystemExit as exit_:
                code = exit_.code
            printed = capsys.readouterr()
            ended.append((code, printed.out, re.sub(r"[^\w.]+", " ", printed.err)))
        (code, out, error), (code_of_module, out_of_module, error_of_module) = ended
        assert code == code_of_module == 2
        assert out == out_of_module == ""
        assert error.replace("i2t convert", "python m i2t.convert") == error_of_module
    for words, program, usage in (
        (["imagine", "--help"], "i2t", "usage: i2t imagine "),
        (["collect", "--help"], "python -m i2t", "usage: python -m i2t collect "),
    ):
        with pytest.raises(SystemExit) as ended_by_help:
            main(words, program=program)
        assert ended_by_help.value.code in (0, None)
        assert usage in capsys.readouterr().out


def test_a_device_in_the_working_folder_is_found(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    Path("lab_devices.py").write_text("")
    assert main(["collect", "--arm", "lab_devices:Arm", "--out", "touches"]) == 2
    assert "lab_devices has no Arm" in capsys.readouterr().err


DRIVE = """
source "$1"
complete -p i2t
for words in "${@:2}"; do
    COMP_WORDS=(i2t $words ""); [[ $words == *- ]] && COMP_WORDS=(i2t $words)
    COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); COMPREPLY=()
    _tyro_i2t
    echo "$words=${COMPREPLY[*]}"
done
"""
WRITE = """
import sys
from i2t.cli.commands import main
try:
    main(["--tyro-write-completion", *sys.argv[1:]])
finally:
    sys.exit("jax" in sys.modules)
"""


@pytest.mark.full
@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_the_completions_of_bash_are_the_sub_commands_and_their_options(tmp_path):
    script = tmp_path / "new" / "i2t"
    subprocess.run([sys.executable, "-c", WRITE, "bash", str(script)], cwd=ROOT, check=True)  # without JAX
    subprocess.run(["bash", "-n", str(script)], check=True)
    options = {"imagine": "--sites", "convert presses": "--indenter", "hand-eye capture": "--host", "place": "--arm"}
    files = ["fit", "convert presses", "imagine --out"]
    typed = ["", "convert", *(f"{words} --" for words in options), *files, "imagine"]
    done = subprocess.run(
        ["bash", "-c", DRIVE, "bash", str(script), *typed], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    first, *lines = done.stdout.splitlines()
    assert first == "complete -o bashdefault -o default -F _tyro_i2t i2t"
    completions = dict(line.split("=", 1) for line in lines)
    assert list(completions) == typed
    assert set(completions[""].split()) == {"-h", "--help", *COMMANDS}
    assert {"presses", "stream"} < set(completions["convert"].split())
    for words, option in options.items():
        assert option in completions[f"{words} --"].split()
    # The only entry of the folder is "new"; objects and data sets are known by name.
    assert [completions[words] for words in files] == ["nominal new", "new", "new"]
    assert {"hammer", "new"} < set(completions["imagine"].split())
    # After a line break, a description would be offered as words to type.
    assert "\\n" not in next(line for line in script.read_text().splitlines() if line.startswith("COMPLETION_SPEC"))


def test_the_completions_of_each_shell_include_files_and_names(tmp_path):
    for shell, first, files in (
        ("zsh", "#compdef i2t", "compadd -a names\n    _files\n"),
        ("bash", "# AUTOMATICALLY", "complete -o default -o bashdefault -F _tyro_i2t i2t\n"),
    ):
        with pytest.raises(SystemExit):
            main(["--tyro-write-completion", shell, str(tmp_path / shell)])
        script = (tmp_path / shell).read_text()
        assert script.startswith(first)
        assert files in script
        assert "--indenter" in script
        assert "'hammer'" in script
        if shutil.which(shell):
            subprocess.run([shell, "-n", str(tmp_path / shell)], check=True)


def test_versions_name_python_and_each_installed_package_that_is_required(capsys):
    assert main(["--versions"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"i2t {PROJECT['version']}"
    listed = {line.split()[0]: line.split()[-1] for line in lines}
    assert listed["Python"] == platform.python_version()
    for requirement in PROJECT["dependencies"]:
        name = re.match(r"[\w-]+", requirement)[0]
        assert listed[name] == metadata.version(name)
    assert "imagine2touch" not in listed


def test_an_installed_command_prints_its_usage(capsys, monkeypatch):
    assert list(PROJECT["scripts"]) == ["i2t", "i2t-collect", "i2t-convert", "i2t-reskin", "i2t-view"]
    for name, entry in PROJECT["scripts"].items():
        monkeypatch.setattr("sys.argv", [f"/usr/bin/{name}", "--help"])
        module, function = entry.split(":")
        with pytest.raises(SystemExit) as ended:
            getattr(importlib.import_module(module), function)()
        assert ended.value.code in (0, None)
        printed = capsys.readouterr().out
        assert (f"usage: {name} " if name != "i2t" else "\ni2t imagine ") in printed
