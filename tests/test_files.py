"""Files that are written whole or not at all."""

import errno
import os

import pytest

from i2t.errors import DataError, FullDiskError
from i2t.files import replacing


def test_a_file_appears_whole_in_a_folder_that_is_made(tmp_path):
    path = tmp_path / "a" / "b" / "note.txt"
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert temporary.parent == path.parent
        assert temporary.name.startswith(".")
        assert temporary.suffix == path.suffix
        assert not path.exists()
    assert path.read_text() == "new"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), ValueError("no"), DataError("no")])
def test_a_block_that_fails_leaves_the_old_file_and_no_other(tmp_path, failure):
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


def test_contents_reach_the_disk_before_their_name_does(tmp_path, monkeypatch):
    path = tmp_path / "note.txt"
    synced = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append((os.fstat(descriptor).st_size, path.exists())))
    with replacing(path) as temporary:
        temporary.write_text("12345")
    assert synced == [(5, False)]


@pytest.mark.parametrize(
    ("number", "kind", "remedy"), [(errno.ENOSPC, FullDiskError, "make room"), (errno.EACCES, DataError, "choose")]
)
def test_a_disk_that_fails_is_one_sentence_and_leaves_nothing(tmp_path, monkeypatch, number, kind, remedy):
    def fail(descriptor):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    path = tmp_path / "note.txt"
    with pytest.raises(DataError, match=f"note.txt: cannot be written .*{remedy}") as found, replacing(path) as file:
        file.write_text("new")
    assert type(found.value) is kind
    assert list(tmp_path.iterdir()) == []
