"""The whole of `python -m experiments.recognize` on its debug preset, and the parts that decide
what is simulated and episodes_from_dataset.
"""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.common import nested
from experiments.recognize import live, report
from experiments.recognize import run as recognize
from i2t import dataset
from i2t.errors import DataError
from i2t.objects import catalogue
from i2t.recognition import episodes as recognition
from i2t.simulation import sites as touch_sites
from i2t.types import ReturnCode


@pytest.fixture(scope="module", autouse=True)
def _taught_once():
    """All commands here learn the same pad from the same touches: once for each world is enough."""
    known, teach = {}, recognize.taught_by

    def taught_by(key, folder, cfg):
        world = str(folder), cfg.errors, cfg.limits
        if world not in known:
            known[world] = teach(key, folder, cfg)
        return known[world]

    with pytest.MonkeyPatch.context() as patch:
        for module in (recognize, live):
            patch.setattr(module, "taught_by", taught_by)
        yield


@pytest.fixture(scope="module")
def finished(trained_run, tmp_path_factory):
    out = tmp_path_factory.mktemp("recognize") / "debug"
    assert recognize.main(["--preset", "debug", "--run", str(trained_run), "--out", str(out)]) == 0
    return out


def test_the_run_leaves_what_it_promises(finished):
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["source"] == "simulated"
    assert set(metrics["sets"]) == {"validation", "all", "primitives", "tools"}
    everything = metrics["sets"]["all"]
    assert everything["sittings"] == 12
    assert everything["objects"] == ["square", "cylinder", "screwdriver", "hammer"]
    expected = {"fused", "tactile only", "position only", "I2T, votes", "proprioception, product", "fused, oracle"}
    assert expected <= set(everything["methods"])
    for values in everything["methods"].values():
        for low, mean, high in zip(*(values["accuracy"][key] for key in ("low", "mean", "high")), strict=True):
            assert 0 <= low <= mean <= high <= 1
    pictures = {path.name for path in finished.glob("*.png")}
    assert pictures >= {"accuracy_all.png", "reliability_all.png", "confusion_all.png", "accuracy_tools.png"}


def test_beliefs_are_probabilities_and_come_back_from_disk(finished):
    played = report.load(finished / "episodes-0.npz")
    for part in played.values():
        for p in part.believed.values():
            assert p.shape == (len(part.truth), 3, len(part.names))
            np.testing.assert_allclose(p.sum(-1), 1, atol=1e-3)
    tools = played["tools"]
    assert set(tools.truth) == {0, 1}
    assert set(np.unique(tools.episodes.site)) <= set(range(6))  # three sites of each tool


def test_a_finished_run_is_not_overwritten(finished, trained_run, capsys):
    assert recognize.main(["--preset", "debug", "--run", str(trained_run), "--out", str(finished)]) == 2
    assert "holds a finished run" in capsys.readouterr().err


def test_what_is_missing_is_named(tmp_path, capsys):
    assert recognize.main(["--run", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert "python -m experiments.train --out" in capsys.readouterr().err


def test_meshes_need_a_unit(trained_run, tmp_path, capsys):
    args = ["--preset", "debug", "--run", str(trained_run), "--objects", "a.stl", "b.stl", "--out", str(tmp_path / "o")]
    assert recognize.main(args) == 2
    assert "--unit mm" in capsys.readouterr().err


def test_recorded_touches_are_replayed(trained_run, tmp_path):
    """Sittings of a recorded set: the run's own touches, of which the belief must find the object more often than not
    guessing would.
    """
    out = tmp_path / "replay"
    data = trained_run / "data.h5"
    args = ["--preset", "debug", "--run", str(trained_run), "--dataset", str(data), "--out", str(out)]
    assert recognize.main(args) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["source"] == "simulated"  # as the data set says of itself
    recorded = metrics["sets"]["recorded"]
    assert recorded["objects"] == list(dataset.load_dataset(data).objects)
    assert recorded["methods"]["fused"]["accuracy"]["mean"][-1] > 1 / len(recorded["objects"])


def test_replay_says_what_it_cannot_use(trained_run):
    recorded = dataset.load_dataset(trained_run / "data.h5")
    with pytest.raises(DataError, match="of which there is no mesh"):
        recognition.episodes_from_dataset(recorded, ["square"], 3)
    with pytest.raises(DataError, match="no run has 100 touches"):
        recognition.episodes_from_dataset(recorded, list(recorded.objects), 100)


def test_a_replayed_press_ends_where_it_was_recorded(trained_run):
    """Sites are where presses ended, so that the advance beyond them is nothing."""
    recorded = dataset.load_dataset(trained_run / "data.h5")
    sites, episodes = recognition.episodes_from_dataset(recorded, list(recorded.objects), 3)
    np.testing.assert_array_equal(episodes.observations.advance, 0)
    T = np.asarray(sites.T_w_t)[episodes.site[0, 1]]
    row = np.flatnonzero(recorded.touches.session == 0)[1]
    np.testing.assert_allclose(T, np.linalg.inv(recorded.touches.T_w_o[row]) @ recorded.touches.T_w_t[row], atol=1e-6)
    air = recorded.touches.code[np.flatnonzero(recorded.touches.session == 0)[:3]] == ReturnCode.AIR
    np.testing.assert_array_equal(np.asarray(episodes.observations.contact)[0], ~air)


def test_telling_sites_follow_the_heuristic():
    """Two boxes of different height side by side: no site of either faces elsewhere, so all of them are equal; the
    sites drawn are all of them in the end.
    """
    surfaces = recognition.prepare_surfaces([catalogue.make_object(name).mesh for name in ("square", "hexagon")])
    sites = recognition.sample_sites(jax.random.key(0), surfaces, ["square", "hexagon"], 4, touch_sites.RECOGNITION_LIMITS)
    drawn = recognition.draw_informative_sites(jax.random.key(1), sites, 50, 4)
    assert drawn.shape == (50, 4)
    assert drawn.min() >= 0
    assert drawn.max() < 8
    owners = sites.owner[drawn]
    assert 0.3 < owners.mean() < 0.7  # both objects are hypotheses


@pytest.mark.parametrize("strange", [0.0, 0.1])
def test_an_arm_touches_where_the_belief_wants_it_to(strange, trained_run, tmp_path, capsys):
    out, touches = tmp_path / "live", 2 if strange else 3
    args = ["--live", "--run", str(trained_run), "--out", str(out), "--there", "hammer"]
    args += ["--sites", "3", "--places", "8", "--touches", str(touches), "--strange", str(strange), "--decoys", "2"]
    assert recognize.main(args) == 0
    result = json.loads((out / "result.json").read_text())
    assert result["source"] == "simulated"
    assert result["there"] == "hammer"
    belief = np.array(result["belief"])
    assert belief.shape == (len(result["sites"]), 5)
    np.testing.assert_allclose(belief.sum(1)[-1], 1 - result["none"], atol=1e-9 if strange else 1e-5)
    if strange:
        assert (belief.sum(1) < 1).all()
    else:
        np.testing.assert_allclose(belief.sum(1), 1, atol=1e-5)
    assert len(belief) == touches or belief[-1].max() >= 0.95  # it ends when it is sure
    assert len(set(result["sites"])) == len(result["sites"])
    kept = dataset.load_dataset(out / "touches")
    assert len(kept) == len(belief)
    assert kept.objects == ("unknown",)
    # What the belief heard of is what was kept.
    assert (kept.touches.code != ReturnCode.FAILED).all()
    assert recognize.main(args) == 2
    assert "another sitting" in capsys.readouterr().err


def test_a_stranger_must_be_possible(tmp_path, capsys):
    for wrong, said in (
        (["--strange", "1"], "--strange 1: give a prob"),
        (["--strange", "0.1", "--decoys", "0"], "decoys"),
    ):
        assert recognize.main(["--live", "--out", str(tmp_path / "live"), *wrong]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1


def test_what_a_study_made_of_a_pad_is_kept(tmp_path):
    part = {"truth": np.arange(3), "0": {"rough": 0.3, "objects": "tools", "I2T, votes": np.ones((3, 2), np.float32)}}
    nested.save(tmp_path / "part-0.npz", part)
    back = nested.load(tmp_path / "part-0.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["part-0.npz"]
    assert list(back) == list(part)
    assert str(back["0"]["objects"]) == "tools"
    assert float(back["0"]["rough"]) == 0.3
    np.testing.assert_array_equal(back["0"]["I2T, votes"], part["0"]["I2T, votes"])


def test_the_paper_s_distances_prefer_what_was_touched():
    """Without any error the model at the contact is nearest to it: proprioception is right, whatever the readings."""
    surfaces = recognition.prepare_surfaces([catalogue.make_object(name).mesh for name in ("square", "cylinder")])
    top = jnp.eye(4).at[:3, :3].set(jnp.diag(jnp.array([1.0, -1.0, -1.0])))
    side = top.at[:3, 3].set(jnp.array([24e-3, 24e-3, 30e-3]))  # near the square's corner, outside the cylinder
    apart = [float(recognition._near(side[None, :3, 3], surface)[0]) for surface in surfaces]
    assert apart[0] == pytest.approx(0, abs=1e-6)
    assert apart[1] == pytest.approx(np.hypot(24e-3, 24e-3) - 30e-3, abs=0.1e-3)
