"""--out of a collection: what is refused before anything large is imported."""

import shutil
import subprocess
import sys

import pytest

from i2t.collect.out_folder import MIN_FREE_BYTES, NOTES_FILE, check_out
from i2t.errors import DataError, FullDiskError

TOUCH = "touch-20261129T013934.489023Z-27d0f1.h5"


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        ((), None),
        ((".lock", "README.md", "index.json"), None),
        ((TOUCH, NOTES_FILE), None),
        ((TOUCH,), "holds touches that this command did not collect; choose another --out"),
        (("touches.h5",), "holds touches.h5, which no collection wrote; move it, or choose another --out"),
        ((TOUCH, NOTES_FILE, "lab.toml"), "holds lab.toml, which no collection wrote"),
    ],
)
def test_only_an_empty_folder_or_a_collection_is_accepted(tmp_path, names, problem):
    for name in names:
        (tmp_path / name).touch()
    before = sorted(tmp_path.iterdir())
    if problem is None:
        check_out(tmp_path)
    else:
        with pytest.raises(DataError, match=problem):
            check_out(tmp_path)
    assert sorted(tmp_path.iterdir()) == before


def test_files_write_protection_and_full_disks_are_refused(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    check_out(tmp_path / "new" / "folder")
    assert not (tmp_path / "new").exists()
    for path in (tmp_path / "file", tmp_path / "file" / "deeper"):
        with pytest.raises(ValueError, match=f"^--out {path}: .*is a file; name a folder"):
            check_out(path)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=MIN_FREE_BYTES // 2))
    with pytest.raises(FullDiskError, match=r"only 25 MiB are free, but 50 are required; free some space"):
        check_out(tmp_path / "new")
    monkeypatch.undo()
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(ValueError, match="is write-protected; name another place"):
        check_out(tmp_path / "new")


def test_a_folder_is_refused_before_numpy_and_jax_are_imported(tmp_path):
    (tmp_path / "photo.png").touch()
    run = (
        "import sys; from i2t.collect.command import main; code = main(['--out', sys.argv[1]]); "
        "print(code, {'numpy', 'jax'} & set(sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", run, tmp_path], capture_output=True, text=True, timeout=60)
    assert result.stdout == "2 set()\n"
    assert "holds photo.png, which no collection wrote" in result.stderr
