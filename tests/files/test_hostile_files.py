"""Hostile files: each is refused with one sentence that names it, in bounded memory and time."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import hostile_files
from helpers.hostile_files import GIB, HOSTILE, READERS, make

from i2t.errors import DataError, DeviceError
from i2t.files.reading import read_bytes, read_text
from i2t.files.writing import file_in, open_without_links

ROOT = Path(__file__).parents[2]
MAX_SECONDS = 5.0
COSTLY = ("20_000", "3000", "gigabytes", "megabytes")
CHEAP = [
    name
    for name, (reader, *_) in HOSTILE.items()
    if reader in ("rig", "raw", "session", "depth", "dataset", "touch") and not any(word in name for word in COSTLY)
]


def refusal(label, path, answer):
    """Explain what is wrong with the response to a hostile file; empty if nothing is."""
    message = answer["said"]
    named = path.name in message or "theirs" in message
    right = answer["user"] and named and "\n" not in message and len(message) <= 800
    if right and answer["seconds"] <= MAX_SECONDS and answer["grown"] <= GIB:
        return ""
    return f"{label}: {answer}"


@pytest.mark.full
def test_every_hostile_file_is_refused_in_one_sentence_in_5_s_and_1_gib(tmp_path):
    files = {
        label: (reader, make(tmp_path / str(i) / name, content))
        for i, (label, (reader, name, content)) in enumerate(HOSTILE.items())
    }
    assert {reader for reader, _ in files.values()} == set(READERS)
    assert max(path.stat().st_size for _, path in files.values() if path.is_file()) < 16 * 2**20
    run = subprocess.run(
        [sys.executable, hostile_files.__file__],
        input="".join(f"{reader}\t{path}\n" for reader, path in files.values()),
        capture_output=True, text=True, timeout=1500, cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])},
    )  # fmt: skip
    answers = [json.loads(line) for line in run.stdout.splitlines()]
    assert len(answers) == len(files), run.stderr[-2000:]
    wrong = [refusal(name, files[name][1], answer) for name, answer in zip(files, answers, strict=True)]
    assert not list(filter(None, wrong))
    assert not list(tmp_path.rglob("i2t-was-here"))  # which a pickle would have made


@pytest.mark.parametrize("label", CHEAP)
def test_a_hostile_file_is_refused_by_its_name(label, tmp_path):
    reader, name, content = HOSTILE[label]
    path = make(tmp_path / name, content)
    with pytest.raises((ValueError, DeviceError, FileNotFoundError)) as raised:
        READERS[reader](path)
    assert refusal(label, path, {"said": str(raised.value), "user": True, "seconds": 0, "grown": 0}) == ""


def test_a_file_is_read_up_to_its_limit_and_a_device_is_refused(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes("grün".encode())
    assert read_text(path, 5) == "grün"
    with pytest.raises(DataError, match="has 5 bytes, but at most 4 bytes are read"):
        read_bytes(path, 4)
    os.mkfifo(tmp_path / "pipe")
    for name in ("pipe", ".", "/dev/zero"):
        with pytest.raises((DataError, IsADirectoryError)):
            read_bytes(tmp_path / name)


def test_a_listed_file_must_be_in_its_folder(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    assert file_in(folder, "a b.png", "list") == folder / "a b.png"
    (folder / "near.png").symlink_to(folder / "a.png")
    assert file_in(folder, "near.png", "list") == folder / "near.png"
    (folder / "far.png").symlink_to("/etc/passwd")
    for name in ("../a.png", "/etc/passwd", "..", "", "a\\b.png", "sub/a.png", "far.png"):
        with pytest.raises(DataError, match=r"list: names .* lies outside"):
            file_in(folder, name, "list")


def test_a_file_is_not_written_through_a_link(tmp_path):
    (tmp_path / "theirs").write_text("precious")
    (tmp_path / "mine").symlink_to(tmp_path / "theirs")
    with pytest.raises(OSError, match=r"symbolic link|symlink|loop"):
        open(tmp_path / "mine", "w", opener=open_without_links)  # noqa: SIM115
    assert (tmp_path / "theirs").read_text() == "precious"
