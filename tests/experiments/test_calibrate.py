"""The calibration experiment on a small synthetic skin, and what it refuses."""

import json
from dataclasses import replace

import numpy as np
import pytest

from experiments.calibrate import run as calibrate
from i2t import dataset as data
from i2t.calibration import load
from i2t.dataset import Dataset, no_wide
from i2t.skin import boards
from i2t.types import ReturnCode, Touches


def recording(n: int, pads: int = 1) -> Dataset:
    """Presses of one tip on a made-up skin."""
    rng = np.random.default_rng(0)
    place, depth = rng.uniform(-12e-3, 12e-3, (n, 2)), rng.uniform(0.5e-3, 4e-3, n)
    centres = rng.uniform(-15e-3, 15e-3, (20, 2))
    g = np.exp(-((place[:, None] - centres) ** 2).sum(-1) / 2 / 9e-3**2) @ rng.normal(scale=60, size=(20, 15))
    T_w_o = np.tile(np.eye(4), (n, 1, 1))
    T_w_o[:, :2, 3] = place
    touches = Touches(
        patch=np.zeros((n, 8, 8)),
        wide=no_wide(n),
        nearest=-depth,
        reading=g * ((depth + 3e-3) / 5e-3)[:, None] ** 1.75 + rng.normal(size=(n, 15)),
        force=np.full(n, np.nan),
        depth=depth,
        T_w_t=np.tile(np.eye(4), (n, 1, 1)),
        T_w_o=T_w_o,
        object=np.zeros(n),
        pad=np.arange(n) % pads,
        run=np.zeros(n),
        code=np.full(n, ReturnCode.UNDEFINED),
    )
    names = tuple(f"skin {i}" for i in range(pads))
    return Dataset(touches, ("tip",), names, ("run",), boards.anyskin_board(), "simulated")


def test_the_experiment_runs_and_is_not_overwritten(tmp_path, capsys):
    data.save(tmp_path / "set.h5", recording(400))
    args = ["--dataset", str(tmp_path / "set.h5"), "--out", str(tmp_path / "out"), "--preset", "debug"]
    assert calibrate.main(args) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["source"] == "simulated"
    assert metrics["warnings"] == []
    assert (tmp_path / "out" / "curves.png").stat().st_size > 1e4
    kept = load(tmp_path / "out" / "calibration.npz")
    assert kept.load == "depth"
    assert kept.predict(np.zeros(2), 2e-3)[0].shape == (15,)
    assert set(metrics["r2"]["random presses"]) > {calibrate.SCRATCH, calibrate.PRETRAINED, calibrate.BEST}
    for methods in metrics["r2"].values():
        for by_count in methods.values():
            assert list(by_count) == ["5", "20"]
    r2 = metrics["r2"]["random presses"]
    # The skin is the structured process's own: it must win where presses are few.
    assert r2[calibrate.STRUCTURED]["20"]["mean"] > r2[calibrate.NEIGHBOURS]["20"]["mean"]
    later = metrics["r2"]["second half in time"]
    assert later[calibrate.EARLIER]["5"]["mean"] > later[calibrate.HEIGHT]["5"]["mean"]  # the skin did not change
    needed = metrics["presses_for_the_same_r2"]["random presses"][calibrate.STRUCTURED]["5"]
    assert needed[calibrate.PLAIN] > 5
    capsys.readouterr()
    assert calibrate.main(args) == 2
    assert "finished run" in capsys.readouterr().err


def test_held_out_presses_are_never_in_a_pool():
    cfg = calibrate.PRESETS["full"]
    presses = calibrate.read(recording(600), "auto")
    held, blocks = calibrate.hold_out(presses, cfg, 0)
    assert held.sum() == 150
    cell = np.floor((1e3 * presses.place - (1e3 * presses.place).min(0)) / 6).astype(int)
    inside = {tuple(c) for c in cell[blocks]}
    assert inside.isdisjoint({tuple(c) for c in cell[~blocks]})
    again, _ = calibrate.hold_out(presses, cfg, 0)
    np.testing.assert_array_equal(held, again)


def test_presses_saved_are_read_off_the_curves():
    needed = calibrate.saved({"slow": {10: [0.1], 100: [0.5], 1000: [0.9]}, "fast": {10: [0.7], 100: [0.95]}})
    assert needed["fast"][10]["slow"] == pytest.approx(10**2.5)  # half-way from 0.5 to 0.9
    assert needed["fast"][100]["slow"] is None
    assert needed["slow"][10]["fast"] == 10


@pytest.mark.parametrize(("n", "pads", "message"), [(400, 2, "several skins"), (9, 1, "too few")])
def test_what_cannot_be_calibrated_is_refused(tmp_path, capsys, n, pads, message):
    data.save(tmp_path / "set.h5", recording(n, pads))
    args = ["--dataset", str(tmp_path / "set.h5"), "--out", str(tmp_path / "out"), "--preset", "debug"]
    assert calibrate.main(args) == 2
    assert message in capsys.readouterr().err


def test_an_earlier_session_of_one_place_helps(tmp_path):
    for name in ("earlier", "later"):
        one = recording(120)
        one.touches.T_w_o[:, :2, 3] = 0
        depth = np.linspace(0.5e-3, 4e-3, 120)
        channels = np.linspace(-60, 60, 15)
        noise = np.random.default_rng(len(name)).normal(size=(120, 15))
        reading = channels * ((depth + 3e-3) / 5e-3)[:, None] ** 1.75 + noise
        mixed = np.random.default_rng(0).permutation(120)
        data.save(
            tmp_path / f"{name}.h5",
            replace(one, touches=one.touches._replace(depth=depth[mixed], reading=reading[mixed])),
        )
    args = ["--dataset", str(tmp_path / "later.h5"), "--earlier", str(tmp_path / "earlier.h5")]
    args += ["--out", str(tmp_path / "out"), "--preset", "debug"]
    assert calibrate.main(args) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["warnings"] == {"earlier": [], "later": []}
    (r2,) = metrics["r2"].values()
    assert r2[calibrate.SESSION[calibrate.EARLIER]]["5"]["mean"] > 0.95
    assert r2[calibrate.SESSION[calibrate.ALONE]]["5"] == r2[calibrate.SESSION[calibrate.ALONE]]["20"]


def test_presses_and_draws_given_replace_those_of_the_preset(tmp_path, capsys):
    args = calibrate.Args(tmp_path, preset="short", presses=(1000, 20), draws=5)
    assert calibrate.tried(args) == replace(calibrate.PRESETS["short"], counts=(20, 1000), draws=5)
    assert calibrate.tried(calibrate.Args(tmp_path)) == calibrate.PRESETS["full"]
    assert calibrate.main(["--dataset", str(tmp_path), "--presses", "1"]) == 2
    assert "at least 2" in capsys.readouterr().err


def test_intervals_over_blocks_are_those_of_whole_blocks():
    rng = np.random.default_rng(0)
    readings, block = rng.normal(size=(60, 15)), np.repeat([0, 1], 30)
    error = 15 * rng.uniform(0, 1, 60) * np.where(block == 0, 0.01, 0.5)
    draws = [error * (1 + share) for share in (-0.5, 0.5)]  # whose mean is the error
    errors = {calibrate.BEST: {20: draws}, calibrate.PLAIN: {20: [2 * error]}}
    found = calibrate.over_blocks(readings, errors, block)
    assert found["blocks"] == 2
    # Two blocks are drawn as a pair of one of them in half of the resamples: the ends are those of each alone.
    alone = [calibrate.explained(readings[block == i], error[block == i]) for i in (1, 0)]
    both = found["r2"][20]
    np.testing.assert_allclose([both["low"], both["high"]], alone, rtol=1e-9)
    assert both["mean"] == pytest.approx(calibrate.explained(readings, error))
    # Twice the error costs what the error itself explains less than all.
    gain = found["differences"][f"{calibrate.BEST} - {calibrate.PLAIN}"][20]
    np.testing.assert_allclose([gain["low"], gain["high"]], [1 - alone[1], 1 - alone[0]], rtol=1e-9)
