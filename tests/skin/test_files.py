"""Pads and other trees of arrays in files: they load unchanged, and anything else is refused in one sentence."""

from collections import namedtuple
from contextlib import suppress

import jax
import numpy as np
import pytest

from i2t.errors import SerializationError
from i2t.files import serialization
from i2t.skin.files import KIND, load_pad, save_pad
from i2t.skin.pad import nominal_pad


@pytest.fixture
def path(tmp_path):
    return tmp_path / "deep" / "pad.npz"


def test_a_saved_pad_loads_unchanged(path):
    pad = nominal_pad()
    save_pad(path, pad, about={"of": "a test"})
    jax.tree.map(np.testing.assert_array_equal, load_pad(path), pad)
    assert serialization.load(path, KIND, type(pad))[1] == {"of": "a test"}
    assert [file.name for file in path.parent.iterdir()] == ["pad.npz"]


def test_a_pad_of_an_earlier_version_is_read(path):
    """Earlier pads had the fields `magnetisation` and `give`, which is the mounting compliance."""
    pad = nominal_pad()._replace(mount_compliance=np.float32(1e-4))
    old = {"magnetization": "magnetisation", "mount_compliance": "give"}
    fields = {old.get(k, k): v for k, v in pad._asdict().items()}
    serialization.save(path, KIND, namedtuple("Pad", fields)(**fields))
    jax.tree.map(np.testing.assert_array_equal, load_pad(path), pad)


def test_a_file_without_a_valid_pad_is_refused_in_one_sentence(path):
    pad = nominal_pad()
    save_pad(path, pad)
    whole = path.read_bytes()
    for make, message in (
        (path.unlink, "no such file"),
        (lambda: path.write_text("nonsense"), "damaged or was not written by i2t"),
        (lambda: np.savez(path, thickness=1.0), "was not written by i2t"),
        (lambda: np.savez(path, about='{"format": "i2t pad"}'), "was not written by i2t"),
        (lambda: serialization.save(path, "i2t other", pad), "holds a i2t other, not a i2t pad"),
        (lambda: serialization.save(path, KIND, pad.board), "lacks"),
        (lambda: save_pad(path, pad._replace(gains=np.full(15, np.nan))), "gains"),
        (lambda: save_pad(path, pad._replace(magnetization=np.zeros((3, 4, 3)))), "magnetization"),
        (lambda: save_pad(path, pad._replace(thickness=np.zeros(()))), "is impossible"),
        (lambda: path.write_bytes(whole[:-100]), "damaged"),
    ):
        make()
        with pytest.raises(SerializationError, match=message) as caught:
            load_pad(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)
    for place in np.random.default_rng(0).integers(0, len(whole), 40):
        changed = bytearray(whole)
        changed[place] ^= 0x55
        path.write_bytes(bytes(changed))
        with suppress(SerializationError):  # a changed byte is either detected or has no effect
            jax.tree.map(np.testing.assert_array_equal, load_pad(path), pad)
    path.write_bytes(whole)
    with pytest.raises(SerializationError, match="cannot be written"):
        save_pad(path / "below" / "pad.npz", load_pad(path))
