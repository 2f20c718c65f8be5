"""Writing of files whole or not at all, and reading of lines from files of others."""

import errno
import gzip
import os
import subprocess
import sys
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from i2t.errors import DataError, FullDiskError
from i2t.files.limits import READ_LIMITS
from i2t.files.reading import read_lines
from i2t.files.writing import replacing
from i2t.viz import save_figure


def test_a_file_appears_whole_in_a_new_folder_after_its_contents_are_on_the_disk(tmp_path, monkeypatch):
    path = tmp_path / "a" / "b" / "note.txt"
    synced = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append((os.fstat(descriptor).st_size, path.exists())))
    with replacing(path) as temporary:
        temporary.write_text("12345")
        assert (temporary.parent, temporary.suffix, temporary.name[0]) == (path.parent, path.suffix, ".")
        assert not path.exists()
    assert synced == [(5, False)]
    assert path.read_text() == "12345"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), DataError("no")])
def test_a_failed_block_leaves_only_the_old_file(tmp_path, failure):
    path = tmp_path / "note.txt"
    path.write_text("old")

    def write_half():
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise failure

    with pytest.raises(type(failure)):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("number", "kind", "remedy"), [(errno.ENOSPC, FullDiskError, "make room"), (errno.EACCES, DataError, "choose")]
)
def test_a_failing_disk_gives_one_sentence_and_leaves_no_file(tmp_path, monkeypatch, number, kind, remedy):
    def fail(descriptor):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    path = tmp_path / "note.txt"
    with pytest.raises(DataError, match=f"note.txt: cannot be written .*{remedy}") as raised, replacing(path) as file:
        file.write_text("new")
    assert type(raised.value) is kind
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(kind, match=rf"touches\.png: cannot be written .*{remedy}"):
        save_figure(Figure(), tmp_path / "touches.png")


FULL_DISK = """
import resource, sys
from i2t.convert.commands import main
sys.dont_write_bytecode = True  # Python would cut modules that it compiles, and others would read them
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))  # as full as a disk with room for a page
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size")
def test_a_command_reports_a_full_disk_in_one_sentence(tmp_path):
    root = Path(__file__).parents[2]
    table, environment = root / "examples" / "data" / "presses.csv", os.environ | {"PYTHONPATH": str(root)}
    words = [sys.executable, "-c", FULL_DISK, "presses", table, "set", "--indenter", "sphere:4.0", "--as-stated"]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True)
    (message,) = done.stderr.splitlines()
    assert done.returncode == 1
    assert message.startswith("error: ")
    assert message.endswith("cannot be written (File too large); make room on its disk, or choose another")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_lines_are_read_without_their_line_breaks(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes("\ufefftime_s,µT\r\n1,2\n\n3,4".encode())
    assert list(read_lines(path)) == ["time_s,µT", "1,2", "", "3,4"]
    packed = tmp_path / "log.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert list(read_lines(packed)) == list(read_lines(path))


@pytest.mark.parametrize(
    ("name", "data", "sentence"),
    [
        ("a.csv", b"1,2\n" + b"9" * READ_LIMITS.line_bytes, "line 2 has more than"),
        ("a.csv", b"1,2\n3,\xff\n", "line 2 is not text"),
        ("a.csv.gz", gzip.compress(b"1,2\n" * 1000)[:-20], "cannot be unpacked"),
        ("a.csv.gz", gzip.compress((b"1," * 500 + b"2\n") * 20_000), "unpacks to more than"),
    ],
    ids=["an endless line", "no text", "a cut archive", "an archive of the same row again and again"],
)
def test_lines_of_a_damaged_file_are_refused_by_its_name(tmp_path, name, data, sentence):
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(DataError, match=sentence) as refused:
        for _ in read_lines(path):
            pass
    assert str(path) in str(refused.value)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(DataError, match="not a regular file"):  # and is not waited for
        next(read_lines(tmp_path / "pipe"))
