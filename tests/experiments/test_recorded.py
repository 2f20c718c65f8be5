"""Recorded touches as episodes: which sessions count, what few episodes say, and by which skin they are judged."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.random_touches import make

from experiments.recognize import __main__ as recognize
from experiments.recognize import pad_sources, recorded, report
from experiments.recognize.config import PRESETS
from experiments.recognize.report import EpisodeResults
from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.hardware.rig import Rig
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.simulation.touches import SimulationErrors
from i2t.skin.files import save_pad
from i2t.skin.pad import nominal_pad
from i2t.skin_models.pad_model import PadModel, with_press_errors
from i2t.types import ReturnCode


def sessions_of(*lengths: int) -> Dataset:
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


def test_every_long_enough_session_counts_and_the_limit_is_said():
    dataset = sessions_of(36, 12, 4, 20)
    chosen = recorded.choose_sessions(dataset, 10, None)
    assert (chosen.names, chosen.touches) == (("run 0", "run 1", "run 3"), 12)
    assert "left out, with fewer: run 2 (4)" in chosen.describe()
    chosen = recorded.choose_sessions(dataset, 10, 20)
    assert (chosen.names, chosen.touches) == (("run 0", "run 3"), 20)
    with pytest.raises(DataError, match="no session has 40 touches with a measured force; the longest has 36"):
        recorded.choose_sessions(dataset, 10, 40)
    chosen = recorded.choose_sessions(sessions_of(3, 2), 10, None)
    assert chosen.names == ("run 0",)
    assert "1 sessions of 3 usable touches, and not the 10 that were asked for" in chosen.describe()


def test_samples_of_one_contact_are_one_touch_with_their_mean():
    dataset = sessions_of(8, 6)
    n = len(dataset)
    time = 10.0 * np.arange(n)
    T_w_t = np.array(dataset.touches.T_w_t)
    rows, apart = np.arange(4, 7), 11  # three samples of a contact; two touches of a place, at another time
    time[rows] = time[4] + [0.0, 0.1, 0.2]
    T_w_t[rows] = T_w_t[4]
    T_w_t[rows, 0, 3] += [0.0, 5e-5, -5e-5]
    T_w_t[apart + 1] = T_w_t[apart]
    held = replace(dataset, touches=dataset.touches._replace(time=time, T_w_t=T_w_t))
    merged = recorded.merge_samples(held)
    assert len(merged) == n - 2
    np.testing.assert_allclose(merged.touches.reading[4], held.touches.reading[rows].mean(0), rtol=1e-6)
    np.testing.assert_array_equal(merged.touches.reading[5:], held.touches.reading[7:])
    np.testing.assert_array_equal(merged.touches.session, np.delete(held.touches.session, rows[1:]))
    assert len(recorded.merge_samples(replace(held, touches=held.touches._replace(time=None)))) == n
    moved = T_w_t.copy()
    moved[5, 0, 3] += 2e-3  # a touch between them elsewhere
    assert len(recorded.merge_samples(replace(held, touches=held.touches._replace(T_w_t=moved)))) == n


@pytest.mark.parametrize("episodes", [1, 2, 8])
def test_few_sessions_get_no_interval(episodes, capsys):
    truth = np.arange(episodes) % 2
    p = np.full((episodes, 3, 2), 0.5)
    right = np.arange(episodes) % 4 < 2  # every second one at the end
    p[:, 2] = np.where((np.eye(2)[truth] > 0) == right[:, None], 0.9, 0.1)
    sessions = np.array([f"run {i}" for i in range(episodes)])
    beliefs = dict.fromkeys(("fused", "readings"), p)
    parts = [{"recorded": EpisodeResults(("star", "mug"), truth, beliefs, None, "skin A", sessions)}]
    scores = report.score_set(report.pool_set(parts, "recorded"))
    fused = scores["methods"]["fused"]
    assert fused["accuracy"]["mean"] == [0.5, 0.5, 0.5 if episodes == 8 else 1.0]
    assert np.isfinite(fused["mean"]["low"]) == (episodes == 8)
    report.print_tables({"source": "real", **report.pads_of(parts, "sessions"), "sets": {"recorded": scores}})
    said = capsys.readouterr().out
    assert f"{episodes} sessions, 1 pads" in said
    assert "95 %, over sessions, for this pad" in said
    assert ("[" in said) == (episodes == 8)


def test_candidates_are_those_of_the_data_set_or_of_the_user():
    args = SimpleNamespace(objects=(), unit=None, dataset=Path("DATA"))
    assert list(recorded.candidate_meshes(args, make(5))) == ["star", "square", "hammer"]
    with pytest.raises(DataError, match=r"touches of mug, of which there is no mesh.*--objects star mug.stl"):
        recorded.candidate_meshes(args, make(5, objects=("star", "mug")))
    with pytest.raises(DataError, match="touches of star only; name the objects to tell apart"):
        recorded.candidate_meshes(args, make(5, objects=("star",)))
    args = SimpleNamespace(objects=(Path("star"), Path("cylinder")), unit=None, dataset=Path("DATA"))
    assert list(recorded.candidate_meshes(args, make(5, objects=("mug",)))) == ["star", "cylinder"]


def find(pad: Path | None, run: Path = Path("none")) -> pad_sources.PadSource:
    return pad_sources.find_pad_source(pad=pad, run=run, cfg=PRESETS["debug"], meshes={}, rig=None)


def test_the_skin_of_a_pad_on_disk_is_known_before_anything_is_fitted(tmp_path):
    save_pad(tmp_path / "left.npz", nominal_pad())
    assert find(tmp_path / "left.npz").skin.pad == "simulated, left"
    save_pad(tmp_path / "left.npz", nominal_pad(), about={"pad": "skin A", "presses": 90, "source": "real"})
    skin = find(tmp_path / "left.npz").skin
    assert skin.pad == "skin A"
    assert skin.made_from.endswith("left.npz, fitted to 90 real presses")
    (tmp_path / "junk.npz").write_bytes(b"junk")
    data.save_dataset(tmp_path / "session.h5", make(30, pixels=8))
    for name, said in {"none.npz": "no such file", "junk.npz": "is damaged", "session.h5": "several skins"}.items():
        with pytest.raises(ValueError, match=f"{name}: .*{said}"):
            find(tmp_path / name)
    with pytest.raises(ValueError, match="holds no finished run"):
        find(None, tmp_path)


def test_a_rig_says_how_far_objects_may_be_off():
    rig = replace(Rig(), object_covariance=np.diag([4e-6] * 3 + [(0.05 * TWIST_LEVER_M) ** 2] * 3))
    errors = pad_sources.with_placement(SimulationErrors(), rig)
    assert errors.placement == pytest.approx(2e-3)
    assert errors.placement_angle == pytest.approx(0.05)


def test_what_a_pad_leaves_of_its_presses_makes_its_readings_less_sure():
    likelihood = SimpleNamespace(inflation=np.float32(1.0))
    likelihood._replace = lambda **new: SimpleNamespace(**new)
    model = PadModel(None, likelihood, np.ones(3), 0.5, np.full((10, 3), 4.0))
    assert with_press_errors(model, 3.0).likelihood.inflation == pytest.approx(1.25)
    assert with_press_errors(model, 0.0).likelihood.inflation == 1.0


REAL = ["live", "--arm", "ur", "--host", "127.0.0.1", "--skin", "reskin"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["live"], ('"simulated pad 0"', '"skin A"')),
        (REAL, ('the skin is "skin"', '"skin A"')),
        ([*REAL, "--pad-name", "skin B"], ('"skin B"', '"skin A"')),
        ([*REAL, "--pad-name", "skin A", "--board", "grid-4x4"], ("16 chips", "5 chips")),
        ([*REAL, "--worn-pad", "b.npz"], ("--worn-pad is for simulated and emulated skins",)),
    ],
)
def test_another_skin_is_refused_before_anything_moves(words, said, tmp_path, capsys):
    out, pad, rig = (tmp_path / name for name in ("live", "a.npz", "lab.toml"))
    save_pad(pad, nominal_pad(), about={"pad": "skin A"})
    Rig().write(rig)
    words = [*words, "--pad", str(pad), "--objects", "star", "hammer", "--rig", str(rig), "--out", str(out)]
    assert recognize.main(words) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert all(part in error for part in said)
    assert not out.exists()
