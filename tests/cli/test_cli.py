"""Commands end with an exit code and one sentence."""

import errno
import io
import os
import sys
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import pytest

from i2t.cli.exit_codes import exit_code_of
from i2t.cli.options import Limits, check_options, read_options, refuse_renamed
from i2t.cli.pipes import ExitCode
from i2t.errors import CheckpointError, DataError, DeviceError, DeviceTimeoutError, FullDiskError

WRONG = (
    ValueError("--unit is no unit"),
    DataError("set.h5: is no data set"),
    CheckpointError("runs/train: holds no predictor"),
    FileNotFoundError(errno.ENOENT, "No such file or directory", "pad.npz"),
    NotADirectoryError(errno.ENOTDIR, "Not a directory", "pad.npz"),
    PermissionError(errno.EACCES, "Permission denied", "/root"),
)
SENTENCES = {  # for errors of the operating system
    "[Errno 2] No such file or directory: 'pad.npz'": "pad.npz: no such file or directory; check the name",
    "[Errno 20] Not a directory: 'pad.npz'": "pad.npz: not a directory; name a folder",
    "[Errno 28] No space left on device": (
        "a file cannot be written (No space left on device); make room on its disk, or name another (--out)"
    ),
    "[Errno 13] Permission denied: '/root'": "/root: permission denied; choose one that you may read and write",
}
BROKEN = (
    DeviceError("the skin fell silent"),
    DeviceTimeoutError("no news from the arm"),
    OSError(errno.ENOSPC, "No space left on device"),
    FullDiskError("set.h5: cannot be written"),
    BrokenPipeError(errno.EPIPE, "Broken pipe"),  # of a connection: somebody reads what is printed
)


@dataclass
class Group:
    share: Annotated[float, Limits(0, 1, above=True)] = 1.0


@dataclass
class Options:
    counts: tuple[Annotated[int, Limits(1)], ...] = (1, 2)
    group: Group = field(default_factory=Group)


def _raising(error):
    def work():
        raise error

    return work


def test_an_error_is_one_sentence_and_its_exit_code(capsys):
    """The code is 2 for wrong use and 1 for failures."""
    for code, errors in ((2, WRONG), (1, BROKEN)):
        for error in errors:
            assert exit_code_of(_raising(error)) == code, error
            assert capsys.readouterr() == ("", f"error: {SENTENCES.get(str(error), str(error))}\n")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (Options(counts=(2, 0)), "--counts is 0; give at least 1"),
        (Options(group=Group(0.0)), "--group.share is 0; give more than 0 and at most 1"),
        (Options(group=Group(1.5)), "--group.share is 1.5; give more than 0 and at most 1"),
        (Options(counts=()), "--counts has no values; give at least one, or leave it out"),
    ],
)
def test_numbers_outside_the_limits_of_their_type_are_refused_by_their_flag(options, sentence):
    check_options(Options(), ["--counts"])
    with pytest.raises(ValueError) as error:  # noqa: PT011  # the whole sentence is compared
        check_options(options, ["--counts"])
    assert str(error.value) == sentence


def test_ctrl_c_prints_the_state_of_the_work(capsys):
    assert exit_code_of(_raising(KeyboardInterrupt()), "stopped; go on with --resume") == 130
    assert capsys.readouterr().err == "\nstopped; go on with --resume\n"


@pytest.mark.skipif(os.name != "posix", reason="pipes of other systems differ")
@pytest.mark.parametrize(("name", "at_once"), [("stdout", True), ("stdout", False), ("stderr", False)])
def test_a_command_whose_output_has_no_reader_ends_silently(monkeypatch, capsys, name, at_once):
    read, write = os.pipe()
    os.close(read)
    stream = open(write, "w")  # noqa: SIM115  # closed below, which must not fail either

    def work():
        print("a line", file=getattr(sys, name), flush=at_once)
        if name == "stderr":
            stream.flush()

    monkeypatch.setattr(sys, name, stream)
    assert exit_code_of(work) == ExitCode.OUTPUT_CLOSED == 141
    print("and another", file=stream)
    stream.close()
    assert capsys.readouterr() == ("", "")


@pytest.mark.skipif(os.name != "posix", reason="pipes of other systems differ")
@pytest.mark.parametrize("buffered_bytes", [1, 1 << 20])  # the reader is missed while help is printed, or at its end
def test_help_that_has_no_reader_ends_silently(monkeypatch, capsys, buffered_bytes):
    read, write = os.pipe()
    os.close(read)
    stream = io.TextIOWrapper(io.BufferedWriter(io.FileIO(write, "w"), buffered_bytes))
    monkeypatch.setattr(sys, "stdout", stream)
    with pytest.raises(SystemExit) as stopped:
        read_options(Group, ["--help"], program="a command")
    assert stopped.value.code == ExitCode.OUTPUT_CLOSED
    stream.close()
    assert capsys.readouterr() == ("", "")


def test_a_command_may_choose_its_exit_code_and_a_defect_of_the_program_is_not_hidden():
    assert [exit_code_of(lambda code=code: code) for code in (None, 0, 1, "a result")] == [0, 0, 1, 0]
    with pytest.raises(ZeroDivisionError):
        exit_code_of(_raising(ZeroDivisionError()))


@pytest.mark.parametrize("words", [["--old", "1"], ["--old=1"], ["--a_b", "new", "former"], ["--a-b=former"]])
def test_an_option_or_value_by_its_former_name_is_answered_with_the_new_one(words):
    class Renamed:
        FORMER_NAMES: ClassVar = {"--old": "--new", "--a-b former": "--a-b new"}

    with pytest.raises(ValueError, match=r"^--\S+( former)? is called --\S+( new)? now"):
        refuse_renamed(Renamed, words)
    refuse_renamed(Renamed, ["--new", "former", "--a-b", "new", "--other", "former"])
    refuse_renamed(Group, words)
