"""The command that reconstructs unseen objects: its refusals, its split, and one small run of everything."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers import random_touches

from experiments.reconstruct.__main__ import main
from experiments.reconstruct.recorded import choose_object, read_touches
from i2t.errors import DataError
from i2t.objects.mesh_files import load_object
from i2t.types import ReturnCode


def _write(folder, number, size):
    (folder / number).mkdir(parents=True)
    box = trimesh.creation.box(size)
    other = trimesh.creation.box(size[::-1]).apply_translation([0.4 * size[0], 0, 0])
    trimesh.util.concatenate([box, other]).export(folder / number / f"{number}.stl")


@pytest.mark.full
def test_folders_that_end_in_0_are_unseen_and_meshes_are_scaled_and_joined(tmp_path):
    from experiments.reconstruct import world
    from experiments.reconstruct.arguments import ReconstructArgs

    for number in range(15):
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
def test_a_small_run_is_reported_with_counts_and_figures(tmp_path, capsys):
    out = tmp_path / "run"
    words = ["--preset", "debug", "--out", str(out), "--conditions", "random", "contact pose only", "one view first"]
    assert main(words) == 0
    report = json.loads((out / "metrics.json").read_text())
    assert report["source"] == "simulated"
    assert set(report["conditions"]) == {"random", "contact pose only", "one view first"}
    assert report["episodes_of_each_condition"] == report["test_objects"] == 2
    for found in report["conditions"].values():
        after = found["after"]
        assert after["0"]["ratio"][0] == pytest.approx(1)
        assert all(0 <= each["coverage"][0] <= 1 and each["chamfer_mm"][0] > 0 for each in after.values())
        assert set(after) == {"0", "1", "2"}
    start = {name: found["after"]["0"]["chamfer_mm"][0] for name, found in report["conditions"].items()}
    assert start["random"] == start["contact pose only"]
    assert start["one view first"] < start["random"]
    assert "hidden_ratio" in report["conditions"]["one view first"]["after"]["2"]
    assert {"errors.png", "bands.png", "growing.png", "table.md"} <= {path.name for path in out.iterdir()}
    assert "grid floor" in capsys.readouterr().out
    assert main(words) == 2


@pytest.mark.full
def test_an_arm_explores_an_object_whose_mesh_may_be_recognised(tmp_path, capsys):
    out = tmp_path / "run"
    words = ["--arm", "simulated", "--true-object", "pyramid", "--preset", "debug", "--touches", "4", "--name", "felt"]
    assert main(["--out", str(out), *words]) == 0
    report = json.loads((out / "metrics.json").read_text())
    assert (report["source"], report["object"]) == ("simulated", "unknown")
    assert report["contacts"] + report["in_air"] == 4
    assert 0 < report["surface_std_mm"]["median"] < 30
    assert {"before", "after"} == set(report["against_the_catalogue"])
    felt = load_object(out / "felt.stl", "m")
    np.testing.assert_allclose(felt.mesh.vertices[:, 2].min(), 0, atol=1e-6)  # it stands as a loaded mesh does
    assert (out / "surface.png").exists()
    assert "next: python -m experiments.recognize live" in capsys.readouterr().out

    again = tmp_path / "again"  # the same touches, as a data set
    assert main(["--out", str(again), "--preset", "debug", "--dataset", str(out / "touches")]) == 0
    recorded = json.loads((again / "metrics.json").read_text())
    assert recorded["surface_std_mm"] == report["surface_std_mm"]


def test_touches_of_a_data_set_are_taken_back_to_first_contact_in_the_objects_frame():
    made = random_touches.make(4, objects=("thing",))
    placed = np.eye(4)
    placed[:3, 3] = 0.1, 0, 0
    down = placed @ np.diag([1.0, -1, -1, 1])
    down[2, 3] = 0.02
    touches = made.touches._replace(
        T_w_o=np.tile(placed, (4, 1, 1)),
        T_w_t=np.tile(down, (4, 1, 1)),
        depth=np.array([1e-3, 1e-3, 1e-3, np.nan]),
        code=np.array([ReturnCode.SKIN, ReturnCode.WRENCH, ReturnCode.SKIN, ReturnCode.AIR]),
        object=np.zeros(4, int),
    )
    dataset = replace(made, touches=touches)
    found = read_touches(dataset, "thing")
    np.testing.assert_array_equal(found.hit, [True, True, True, False])
    np.testing.assert_allclose(found.T_o_t[:, :3, 3], [[0, 0, 0.021]] * 3 + [[0, 0, 0.02]], atol=1e-6)
    with pytest.raises(DataError, match="a surface needs 3 or more"):
        read_touches(dataset.select(np.array([0, 1, 3])), "thing")
    with pytest.raises(DataError, match="holds no touch of other; pass --object with one of thing"):
        choose_object(dataset, "other", Path("DATA"))
