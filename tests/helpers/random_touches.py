"""Touches of random contents, for tests of readers and writers."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.dataset import Dataset, Image, Record, Series, missing_views
from i2t.skin import boards
from i2t.types import ReturnCode, Touches, Truth


def make(n, seed=0, truth=False, view=False, objects=("star", "square", "hammer"), pixels=48, board="reskin"):
    """Touches of random contents in every field; with the truth also times."""
    board = boards.make_board(board)
    rng, readings = np.random.default_rng(seed), board.num_readings

    def poses():
        T = np.tile(np.eye(4), (n, 1, 1))
        T[:, :3, :3] = Rotation.random(n, rng).as_matrix() if n else T[:, :3, :3]
        T[:, :3, 3] = rng.uniform(-0.5, 0.5, (n, 3))
        return T

    def sometimes(values):
        return np.where(rng.random(n) < 0.3, np.nan, values)

    touches = Touches(
        patch=rng.uniform(0, 4e-3, (n, pixels, pixels)).clip(0, 3.9e-3),
        view=rng.uniform(0, 4e-3, (n, 72, 72)) if view else missing_views(n),
        nearest=sometimes(rng.normal(0, 1e-3, n)),
        reading=rng.normal(0, 50, (n, readings)),
        force=sometimes(rng.uniform(0, 8, n)),
        travel=sometimes(rng.uniform(0, 1e-3, n)),
        T_w_t=poses(),
        T_w_o=poses(),
        object=rng.integers(0, len(objects), n),
        pad=rng.integers(0, 2, n),
        session=rng.integers(0, 4, n),
        code=rng.integers(-1, 5, n),
        truth=Truth(rng.uniform(0, 4e-3, (n, 72, 72)), *rng.normal(size=(3, n)), rng.normal(size=(n, readings)))
        if truth
        else None,
        time=sometimes(1.7e9 + np.cumsum(rng.uniform(0.1, 10, n))) if truth else None,
    )
    names = ("pad é", "pad b"), ("run 1", "run 2", "run 3", "run 4")
    return Dataset(touches, objects, *names, board, "simulated", meta={"seed": str(seed)})


def recorded_presses(n=40, objects=("star", "mug"), **changed):
    """Touches that are all of one skin, measured, and ended by the skin."""
    dataset = make(n, objects=objects, pixels=8)
    own = {
        "pad": np.zeros(n), "code": np.full(n, ReturnCode.SKIN), "force": np.full(n, 1.0), "travel": np.full(n, 1e-4),
        "object": np.arange(n) % len(objects), "session": np.arange(n) % 4,
    }  # fmt: skip
    return replace(dataset, touches=dataset.touches._replace(**(own | changed)))


def sessions_of(*lengths):
    """Sessions of so many usable touches, each with one that failed and one without a force."""
    session = np.repeat(np.arange(len(lengths)), np.array(lengths) + 2)
    n = len(session)
    begin = np.flatnonzero(np.diff(session, prepend=-1))
    code, force = np.full(n, ReturnCode.SKIN), np.ones(n)
    code[begin] = ReturnCode.FAILED
    force[begin + 1] = np.nan
    made = make(n, pixels=8)
    touches = made.touches._replace(session=session, code=code, force=force, pad=np.zeros(n), object=session % 3)
    return replace(made, touches=touches, sessions=tuple(f"run {i}" for i in range(len(lengths))))


def assert_equal(a, b):
    """Two data sets agree in every field."""
    for name in ("objects", "pads", "sessions", "source", "window", "reach"):
        assert getattr(a, name) == getattr(b, name), name
    assert dict(a.meta) == dict(b.meta)
    for x, y in zip(a.board, b.board, strict=True):
        np.testing.assert_array_equal(x, y)
    for name in Touches._field_defaults:
        assert (getattr(a.touches, name) is None) == (getattr(b.touches, name) is None), name
    ours, theirs = ([field for field in dataset.touches if isinstance(field, np.ndarray)] for dataset in (a, b))
    for mine, yours in ((ours, theirs), (a.touches.truth or (), b.touches.truth or ())):
        for x, y in zip(mine, yours, strict=True):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)


def record(touch):
    """Other data that may be recorded with one touch."""
    rng = np.random.default_rng(7)
    reading = Series(1.7e9 + np.arange(800) / 400, rng.normal(size=(800, 15)), tuple("abcdefghijklmno"), "uT")
    return Record(
        touch,
        images={
            "depth": Image(rng.integers(0, 2**16, (48, 64), np.uint16), 1e-4, "m"),
            "colour": Image(rng.integers(0, 256, (48, 64, 3), np.uint8)),
        },
        series={"tactile": reading, "wrench": Series(np.zeros(0), np.zeros((0, 6)), tuple("uvwxyz"), "N, Nm")},
        events=((1.7e9, "look"), (1.7e9 + 2.5, "contact: Berührung")),
        counters={"dropped frames": 3},
    )
