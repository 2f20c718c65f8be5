"""The whole of `python -m experiments.recognize` on its debug preset, simulated and live, and of the studies,
which share what it compiles.
"""

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from experiments.common.runs import load_part
from experiments.recognize import __main__ as recognize
from experiments.recognize import paper, report
from experiments.recognize.arguments import LIVE_OBJECTS, DatasetArgs, LiveArgs, SimulateArgs
from experiments.recognize.config import PRESETS
from experiments.recognize.run import configure
from experiments.studies import __main__ as studies
from experiments.studies import physics
from experiments.train import __main__ as train
from i2t import dataset
from i2t.collect.arguments import SkinArgs
from i2t.objects import catalogue
from i2t.objects.named import read_meshes
from i2t.recognition.recognizer import MAX_EMPTY_DRAWS, ObjectRecognizer, RecognizerConfig
from i2t.skin_models.pad_model import load_pad_model
from i2t.types import ReturnCode
from tools.gallery.arguments import FIGURE_NAMES
from tools.gallery.figures import FIGURES
from tools.gallery.story import Story
from tools.reproduce.recognition_tables import STUDY_TABLES


@pytest.fixture(scope="module")
def finished(trained_run, tmp_path_factory):
    out = tmp_path_factory.mktemp("recognize") / "debug"
    assert recognize.main(["--preset", "debug", "--pad-model", str(trained_run), "--out", str(out)]) == 0
    return out


@pytest.mark.full
def test_the_run_writes_the_promised_files(finished, trained_run, capsys):
    written = json.loads((finished / "metrics.json").read_text())
    assert written["source"] == "simulated"
    assert set(written["sets"]) == {"validation", "all", "primitives", "tools"}
    everything = written["sets"]["all"]
    assert everything["episodes"] == 12
    assert everything["objects"] == ["square", "cylinder", "screwdriver", "hammer"]
    expected = {
        "readings", "presence", "position", "readings and position", "readings and presence", "position and presence",
        "fused", "fused, oracle",
        "Imagine2touch (paper's network, depth), votes", "paper's network and measured force, depth, votes",
        "same rules, Gaussian process, votes", "same rules, Gaussian process at the median force, votes",
        "same rules, constant reading, votes", "proprioception, product",
    }  # fmt: skip
    assert expected <= set(everything["methods"])
    # The run on its debug preset trains no network on masks, so there is no such row.
    assert not [name for name in everything["methods"] if "mask" in name or "I2T" in name]
    assert written["pads"] == ["pad 0"]
    assert everything["pools"] == 12  # each episode has sites of its own
    assert set(everything["methods"]["fused"]["by_object"]) == set(everything["objects"])
    for values in everything["methods"].values():
        for low, mean, high in zip(*(values["accuracy"][key] for key in ("low", "mean", "high")), strict=True):
            assert 0 <= low <= mean <= high <= 1
    pictures = {path.name for path in finished.glob("*.png")}
    assert pictures >= {"accuracy_all.png", "confusion_all.png", "accuracy_tools.png"}
    played = report.from_part(load_part(finished / "episodes-0.npz"))
    for part in played.values():
        for p in part.beliefs.values():
            assert p.shape == (len(part.truth), 3, len(part.names))
            np.testing.assert_allclose(p.sum(-1), 1, atol=1e-3)
    tools = played["tools"]
    assert set(tools.truth) == {0, 1}
    assert len(np.unique(tools.episodes.site)) == tools.episodes.site.size  # no two touches share a site
    assert len(np.unique(tools.pool)) == 6  # two episodes to a pool
    assert recognize.main(["--preset", "debug", "--pad-model", str(trained_run), "--out", str(finished)]) == 2
    assert "holds a finished run" in capsys.readouterr().err


@pytest.mark.full
def test_the_papers_own_loop_runs_alone_and_resumes(trained_run, tmp_path, monkeypatch):
    out = tmp_path / "paper"
    args = ["--method", "paper", "--preset", "debug", "--pad-model", str(trained_run), "--out", str(out)]
    assert recognize.main(args) == 0
    before = (out / "metrics.json").read_text()
    written = json.loads(before)
    assert written["method"] == "the paper's loop"
    assert written["epochs"] == [12]
    assert set(written["sets"]) == {"primitives", "tools"}
    tools = written["sets"]["tools"]
    sources = {name.rpartition(", ")[0] for name in tools["methods"]}
    assert sources == {
        "Imagine2touch (paper's network, depth)", "paper's network and measured force, depth",
        "same rules, Gaussian process", "same rules, Gaussian process at the median force",
        "same rules, constant reading", "proprioception",
    }  # fmt: skip
    assert (tools["episodes"], tools["pools"]) == (12, 6)
    everything = written["mean of the sets"]["proprioception, votes"]
    parts = [
        written["sets"][name]["methods"]["proprioception, votes"]["accuracy"]["mean"][-1] for name in written["sets"]
    ]
    assert everything["mean"] == pytest.approx(np.mean(parts))  # two objects in each
    # Of a finished loop whose tables are lost, nothing is touched again.
    (out / "metrics.json").unlink()
    monkeypatch.setattr(paper, "play_set", None)
    assert recognize.main([*args, "--resume"]) == 0
    assert (out / "metrics.json").read_text() == before


@pytest.mark.full
def test_recorded_touches_are_trained_on_and_recognised(trained_run, tmp_path, capsys):
    """As with a lab's own data set, the belief must find the object more often than guessing."""
    data, run, out = trained_run / "data.h5", tmp_path / "run", tmp_path / "recognized"
    words = ["--preset", "debug", "--methods", "paper-depth", "gp", "--epochs", "2", "--dataset", str(data)]
    assert train.main([*words, "--out", str(run)]) == 0
    assert "pad model of" in capsys.readouterr().out
    words = ["--preset", "debug", "--pad-model", str(run), "--dataset", str(data), "--out", str(out)]
    assert recognize.main(words) == 0
    written = json.loads((out / "metrics.json").read_text())
    assert written["source"] == "simulated"  # as the data set says of itself
    assert written["pad_model"]["other_skin"] is None
    recorded = written["sets"]["recorded"]
    assert recorded["objects"] == list(dataset.load_dataset(data).objects)
    assert recorded["methods"]["fused"]["accuracy"]["mean"][-1] > 1 / len(recorded["objects"])


LIVE = ["--num-sites", "3", "--num-particles", "16", "--num-surrogates", "2", "--true-object", "star"]


def test_the_default_objects_of_a_live_run_differ_in_their_outlines_only():
    """They are prisms of one height, and no wider than a skin of 17 mm from one another."""
    corners = [catalogue.make_object(name).mesh.vertices for name in LIVE_OBJECTS]
    assert len(set(LIVE_OBJECTS)) == 3
    for vertices in corners:
        np.testing.assert_allclose(np.unique(vertices[:, 2].round(6)), [0, 0.03], atol=1e-6)
    sizes = np.array([np.ptp(vertices[:, :2], axis=0) for vertices in corners])
    assert np.ptp(sizes, axis=0).max() < 17e-3
    assert LiveArgs().contact_probability == 0.95


def test_a_live_run_without_a_trained_run_uses_the_ready_pad_model_of_a_simulated_skin(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    real = LiveArgs(skin=SkinArgs("reskin"))
    assert (LiveArgs().used_pad_model, real.used_pad_model) == (Path("nominal"), Path("runs/train"))
    Path("runs/train").mkdir(parents=True)
    assert LiveArgs().used_pad_model == Path("runs/train")
    assert LiveArgs(pad_model=Path("nominal")).used_pad_model == Path("nominal")


@pytest.mark.full
def test_the_default_objects_of_a_live_run_are_met_at_all_sites():
    args = LiveArgs(num_particles=16)
    config = RecognizerConfig(num_particles=16, min_contact_probability=args.contact_probability)
    model = load_pad_model("nominal").model
    recognizer = ObjectRecognizer(jax.random.key(args.seed), model, read_meshes(LIVE_OBJECTS), config=config)
    assert recognizer.table.hit.mean(-1).min() >= 0.95
    assert len(recognizer.sites.owner) > 0.8 * len(LIVE_OBJECTS) * args.num_sites  # few are left out
    assert recognizer.safe.all()


@pytest.mark.full
def test_an_arm_touches_the_site_chosen_from_the_belief(trained_run, tmp_path, capsys):
    out = tmp_path / "live"
    args = ["live", "--pad-model", str(trained_run), "--out", str(out), *LIVE]
    args += ["--max-touches", "2", "--prior-unknown", "0.1"]
    assert recognize.main(args) == 0
    result = json.loads((out / "result.json").read_text())
    assert result["source"] == "simulated"
    assert result["true_object"] == "star"
    belief = np.array(result["belief"])
    assert belief.shape == np.shape(result["evidence"]["reading"]) == (2, 3)
    assert (belief.sum(1) < 1).all()
    np.testing.assert_allclose(belief.sum(1)[-1], 1 - result["unknown"], atol=1e-9)
    assert len(set(result["sites"])) == len(result["sites"]) == 2
    assert len(result["met_air"]) == len(result["would_be_met"]) == len(belief)
    output = capsys.readouterr().out
    assert "; predicted probability of contact: " in output  # what a touch told, air included
    assert output.count("  evidence for ") == 2
    assert "nan" not in output
    assert np.min(result["would_be_met"]) > 0.9
    kept = dataset.load_dataset(out / "touches")
    assert len(kept) == len(belief)
    assert kept.objects == ("unknown",)
    assert (kept.touches.code != ReturnCode.FAILED).all()  # what the belief heard of is what was kept
    assert recognize.main(args) == 2
    assert "another episode" in capsys.readouterr().err


# Those that play an episode of their own, register whole objects or fit many presses take minutes.
LONG_FIGURES = {"overview", "episode", "registration"}


@pytest.mark.full
def test_figures_of_the_gallery_are_drawn(trained_run):
    story = Story(trained_run, world=PRESETS["debug"])
    for name in set(FIGURE_NAMES) - LONG_FIGURES:
        canvas = FigureCanvasAgg(FIGURES[name](story))
        canvas.draw()
        colours = np.unique(np.asarray(canvas.buffer_rgba()).reshape(-1, 4), axis=0)
        assert len(colours) > 30, name


@pytest.mark.full
def test_an_arm_stops_with_a_message_if_no_site_is_safe(trained_run, tmp_path, capsys, monkeypatch):
    """Other candidates are drawn first, up to the stated number of draws; then no touch is made."""
    draws = []

    def none_is_safe(self, state, key):
        draws.append(key)
        return -1

    monkeypatch.setattr(ObjectRecognizer, "_choose", none_is_safe)
    monkeypatch.setattr(ObjectRecognizer, "warm_up", lambda self: None)
    out = tmp_path / "live"
    assert recognize.main(["live", "--pad-model", str(trained_run), "--out", str(out), *LIVE]) == 2
    assert len(draws) == MAX_EMPTY_DRAWS
    captured = capsys.readouterr()
    assert f"no site is safe for all possible objects in {MAX_EMPTY_DRAWS} draws" in captured.out
    assert "no site is safe for all possible objects" in captured.err
    assert not list((out / "touches").glob("*.h5"))


@pytest.mark.full
def test_a_study_runs_and_resumes_from_its_results(trained_run, tmp_path):
    out = tmp_path / "study"
    words = ["physics", "--preset", "debug", "--pad-model", str(trained_run), "--out", str(out)]
    assert studies.main(words) == 0
    before = (out / "metrics.json").read_text()
    metrics = json.loads(before)
    assert metrics["source"] == "simulated"
    assert set(metrics["tables"]) == set(STUDY_TABLES["physics"])
    assert metrics["episodes"] == 8
    rows = [tuple(row[:3]) for row in metrics["tables"]["methods"]["rows"] if row[1] == "fused"]
    own = ["20", physics.ALL, physics.ORACLE]
    assert [touches for name, _, touches in rows if name == physics.MATCHED] == own
    assert [touches for name, _, touches in rows if name != physics.MATCHED] == [physics.ELSEWHERE, *own]
    (out / "metrics.json").unlink()
    assert studies.main([*words, "--resume"]) == 0  # from what was made of the pad
    assert (out / "metrics.json").read_text() == before


def test_a_few_episodes_are_played_unless_touches_were_recorded(tmp_path):
    assert configure(SimulateArgs()) == PRESETS["short"]
    assert DatasetArgs(tmp_path).preset == "paper"
    assert configure(SimulateArgs(preset="paper", episodes=7)).paper_episodes == 14
