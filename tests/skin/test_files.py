"""Pads and other trees of arrays on disk: the same again, and one clear sentence for everything else."""

from collections import namedtuple

import jax
import numpy as np
import pytest

from i2t import serialization
from i2t.errors import SerializationError
from i2t.skin.files import KIND, load_pad, save_pad
from i2t.skin.pad import nominal_pad


def test_a_pad_comes_back_as_it_was(tmp_path):
    pad = nominal_pad()
    save_pad(tmp_path / "deep" / "pad.npz", pad, about={"of": "a test"})
    again = load_pad(tmp_path / "deep" / "pad.npz")
    assert jax.tree.structure(pad) == jax.tree.structure(again)
    for a, b in zip(jax.tree.leaves(pad), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert serialization.load(tmp_path / "deep" / "pad.npz", KIND, type(pad))[1] == {"of": "a test"}
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["pad.npz"]


def test_a_pad_of_an_earlier_version_is_read(tmp_path):
    """Before its fields were renamed a pad had a `magnetisation`, and a `give` for its mounting compliance."""
    pad = nominal_pad()._replace(mount_compliance=np.float32(1e-4))
    fields = {
        {"magnetization": "magnetisation", "mount_compliance": "give"}.get(k, k): v for k, v in pad._asdict().items()
    }
    serialization.save(tmp_path / "pad.npz", KIND, namedtuple("Pad", fields)(**fields))
    jax.tree.map(np.testing.assert_array_equal, load_pad(tmp_path / "pad.npz"), pad)


def test_what_is_no_pad_is_refused_in_one_sentence(tmp_path):
    path = tmp_path / "pad.npz"

    def refused(message: str) -> None:
        with pytest.raises(SerializationError, match=message) as caught:
            load_pad(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)

    refused("no such file")
    path.write_text("nonsense")
    refused("damaged or was not written by i2t")
    np.savez(path, thickness=1.0)
    refused("was not written by i2t")
    serialization.save(path, "i2t other", nominal_pad())
    refused("holds a i2t other, not a i2t pad")
    serialization.save(path, KIND, nominal_pad().board)
    refused("lacks")
    save_pad(path, nominal_pad()._replace(gains=np.full(15, np.nan)))
    refused("gains")
    save_pad(path, nominal_pad()._replace(magnetization=np.zeros((3, 4, 3))))
    refused("magnetization")
    save_pad(path, nominal_pad()._replace(thickness=np.zeros(())))
    refused("cannot be")
    save_pad(path, nominal_pad())
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    refused("damaged")
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(whole), 40):  # any changed byte is found or changes nothing that is read
        changed = bytearray(whole)
        changed[place] ^= 0x55
        path.write_bytes(bytes(changed))
        try:
            load_pad(path)
        except SerializationError:
            continue
    path.write_bytes(whole)
    load_pad(path)
    with pytest.raises(SerializationError, match="cannot be written"):
        save_pad(path / "below" / "pad.npz", nominal_pad())
