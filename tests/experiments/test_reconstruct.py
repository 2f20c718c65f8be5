"""The command that reconstructs unseen objects: its refusals, its split, and one small run of everything."""

import json

import numpy as np
import pytest
import trimesh

from experiments.reconstruct.__main__ import main
from experiments.reconstruct.arguments import CONDITIONS


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--meshes", "nowhere"], "nowhere"),
        (["--side", "0.09", "0.06"], "give the smaller one first"),
        (["--conditions", "guess"], "is none of random"),
    ],
)
def test_what_does_not_go_together_is_refused_in_one_sentence(words, sentence, tmp_path, capsys):
    assert main(["--out", str(tmp_path / "run"), *words]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def _write(folder, number, size):
    (folder / number).mkdir(parents=True)
    box = trimesh.creation.box(size)
    other = trimesh.creation.box(size[::-1]).apply_translation([0.4 * size[0], 0, 0])
    trimesh.util.concatenate([box, other]).export(folder / number / f"{number}.stl")


@pytest.mark.full
def test_folders_that_end_in_0_are_unseen_and_meshes_are_scaled_and_joined(tmp_path):
    from experiments.reconstruct import world
    from experiments.reconstruct.arguments import ReconstructArgs

    for number in range(13):
        _write(tmp_path, f"{number:03d}", (20.0 + number, 30.0, 12.0))
    args = ReconstructArgs(meshes=tmp_path, unit="mm", test=5, train=6)
    split = world.split_objects(args, args.sizes)
    assert [item.name for item in split.test] == ["000", "010"]
    names = [item.name for part in split for item in part]
    assert len(set(names)) == len(names)
    assert (len(split.train), len(split.validation)) == (6, args.sizes.validation)
    for item in split.test:
        side = np.ptp(item.mesh.vertices, axis=0).max()
        assert 60e-3 <= side <= 90e-3
        assert trimesh.Trimesh(item.mesh.vertices, item.mesh.faces).body_count == 1
    with pytest.raises(ValueError, match=r"0 unseen files .* and 1 others"):
        world.split_objects(ReconstructArgs(meshes=tmp_path / "001"), args.sizes)


@pytest.mark.full
def test_a_small_run_of_everything_is_reported_with_counts_and_figures(tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["--preset", "debug", "--out", str(out)]) == 0
    report = json.loads((out / "metrics.json").read_text())
    assert report["source"] == "simulated"
    assert set(report["conditions"]) == set(CONDITIONS)
    assert report["episodes_of_each_condition"] == report["test_objects"] == 2
    for name, found in report["conditions"].items():
        after = found["after"]
        assert after["0"]["ratio"][0] == pytest.approx(1)
        assert all(0 <= each["coverage"][0] <= 1 and each["chamfer_mm"][0] > 0 for each in after.values())
        assert set(after) == ({"0", "1"} if name == "oracle" else {"0", "1", "2"})
    start = {name: found["after"]["0"]["chamfer_mm"][0] for name, found in report["conditions"].items()}
    assert len({start[name] for name in ("random", "even", "uncertainty", "reduction", "contact pose only")}) == 1
    assert start["one view first"] < start["random"]
    assert "hidden_ratio" in report["conditions"]["one view first"]["after"]["2"]
    assert {"errors.png", "bands.png", "growing.png", "table.md"} <= {path.name for path in out.iterdir()}
    assert "grid floor" in capsys.readouterr().out
    assert main(["--preset", "debug", "--out", str(out)]) == 2


@pytest.mark.full
def test_an_object_on_a_table_is_touched_from_above_only(tmp_path):
    words = ["--preset", "debug", "--reach", "table", "--conditions", "uncertainty", "--out", str(tmp_path / "run")]
    assert main(words) == 0
    report = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert list(report["conditions"]) == ["uncertainty"]
    assert report["reach"] == "table"
    assert report["share_of_gap"] == {}
