"""The command that reconstructs: objects and patches that no method has seen, and objects from recorded touches."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import random_touches
from scipy.spatial import cKDTree

from experiments.reconstruct.__main__ import main
from experiments.reconstruct.arguments import ReconstructArgs
from experiments.reconstruct.patch import CURVE, METHODS, PRIOR
from experiments.reconstruct.patch_scores import edge_of
from experiments.reconstruct.recorded import choose_object, read_touches, swept_distance
from experiments.reconstruct.world import Reality, Session, split_objects
from i2t.dataset import save_dataset
from i2t.errors import DataError
from i2t.objects import make_object
from i2t.objects.mesh_files import load_object
from i2t.objects.solids import centre_box
from i2t.patches.dimensions import PATCH_WINDOW
from i2t.reconstruction.signed_distances import sample_surface
from i2t.rendering.render import prepare_surface, stack_surfaces
from i2t.types import ReturnCode


@pytest.mark.full
def test_a_small_run_is_reported_with_counts_and_figures(tmp_path, capsys):
    out = tmp_path / "run"
    words = [
        "--preset",
        "debug",
        "--out",
        str(out),
        "--conditions",
        "reading",
        "contact pose only",
        "contact pose only, likeliest shapes",
        "reading, fitted pad, 3 mm and 5 degrees",
        "contact pose only, 3 mm and 5 degrees",
        "oracle",
        "random sites",
        "after a view",
    ]
    with jax.debug_key_reuse(False):  # in a batch of loops JAX takes the keys of a loop's steps for one key
        assert main(words) == 0
    report = json.loads((out / "metrics.json").read_text())
    assert report["source"] == "simulated"
    assert set(report["conditions"]) == set(words[words.index("--conditions") + 1 :])
    assert report["episodes_of_each_condition"] == report["test_objects"] == 2
    for found in report["conditions"].values():
        after = found["after"]
        assert all(0 <= each["coverage"][0] <= 1 and each["chamfer_mm"][0] > 0 for each in after.values())
        assert set(after) == {"0", "1", "2"}
    start = {name: found["after"]["0"]["chamfer_mm"][0] for name, found in report["conditions"].items()}
    assert start["reading"] == start["contact pose only"] != start["after a view"]
    ratios = {name: found["after"]["0"]["ratio"][0] for name, found in report["conditions"].items()}
    assert ratios["reading"] == pytest.approx(1) != ratios["after a view"]
    assert set(report["less_than_pose"]) == {"reading", "reading, fitted pad, 3 mm and 5 degrees"}
    read, *poses = (
        found["after"]["2"]["chamfer_mm"][0]
        for name, found in report["conditions"].items()
        if name in ("reading", "contact pose only", "contact pose only, likeliest shapes")
    )
    assert report["less_than_pose"]["reading"]["2"][0] == pytest.approx(1 - read / min(poses))
    assert set(report["share_of_oracles_gap"]) == {"reading"}
    assert {"errors.png", "growing.png"} <= {path.name for path in out.iterdir()}
    assert "grid floor" in capsys.readouterr().out
    assert main(words) == 2


def test_predictions_equal_the_readings_of_a_perfect_touch_on_the_true_object():
    mesh = centre_box(make_object("stamp-cross").mesh)
    reality = Reality([mesh], stack_surfaces([prepare_surface(mesh)]), None, [], [])
    session = Session(reality, 0, 0)
    site = np.diag([1.0, -1, -1, 1])
    site[2, 3] = mesh.vertices[:, 2].max() - 5e-3  # it is met before
    (foreseen,) = session.foresee(site[None])
    touched = session.touch(site, "patch")
    tops = session.mesh.vertices[:, 2].max()
    assert abs(touched.region.T_o_t[2, 3] - tops) < 0.3e-3
    np.testing.assert_allclose(foreseen.region.T_o_t, touched.region.T_o_t, atol=0.3e-3)  # the arm repeats to so much
    felt = foreseen.points[:-1]
    assert len(felt) > 4
    closest = cKDTree(sample_surface(session.mesh, 100_000)[0]).query(felt)[0]
    assert np.median(closest) < 0.3e-3


@pytest.mark.full
def test_meshes_of_a_folder_are_learnt_from_and_tested_on(tmp_path, capsys):
    folder = tmp_path / "meshes"
    for number in range(12):
        box = trimesh.creation.box((30 + number, 20, 40 - number) if number != 10 else (40, 30, 0.5))
        (folder / f"{number:02}").mkdir(parents=True)
        box.export(folder / f"{number:02}" / f"box{number:02}.stl")
    (folder / "05" / "box05.stl").write_bytes(b"no mesh")
    words = ["--objects", str(folder), "--unit", "mm", "--across-mm", "50", "60", "--preset", "debug", "--touches", "1"]
    out = tmp_path / "run"
    assert main([*words, "--out", str(out), "--conditions", "contact pose only"]) == 0
    said = capsys.readouterr().out
    assert "left out" in said
    assert "box05.stl" in said
    assert "00/box00: " in said
    assert "left out: 10/box10: open, or too thin" in said
    report = json.loads((out / "metrics.json").read_text())
    assert report["objects"] == {"validation": ["01/box01"], "test": ["00/box00"]}
    assert report["library"]["shapes"] == 4
    args = ReconstructArgs(objects=folder, unit="mm", preset="debug", train=20)
    assert [len(part) for part in split_objects(args, hold_out=False)] == [0, 0, 11]
    box.export(folder / "00" / "box00.obj")
    assert main([*words, "--out", str(tmp_path / "twice")]) == 2
    assert "two files have one name" in capsys.readouterr().err
    (folder / "00" / "box00.obj").unlink()
    (folder / "00" / "box00.stl").unlink()
    (folder / "10" / "box10.stl").unlink()
    (folder / "01" / "box01.stl").unlink()
    for number in range(2, 10):
        (folder / f"{number:02}" / f"box{number:02}.stl").unlink()
    assert main([*words, "--out", str(tmp_path / "few")]) == 2
    assert "holds 1 usable meshes" in capsys.readouterr().err
    assert not (tmp_path / "few").exists()


@pytest.mark.full
def test_every_method_is_scored_on_presses_of_unseen_shapes(tmp_path, capsys):
    out = tmp_path / "run"
    with jax.debug_key_reuse(False):  # in a batch of loops JAX takes the keys of a loop's steps for one key
        assert main(["patch", "--preset", "debug", "--out", str(out)]) == 0
    report = json.loads((out / "metrics.json").read_text())
    assert report["source"] == "simulated"
    assert report["touches"] == report["counts"]["test"] > 0
    prior, curve = report["methods"][PRIOR], report["methods"][CURVE]
    assert set(report["methods"]) == set(METHODS)
    assert prior["crps_ratio"][0] == 1
    assert prior["mask_skill"][0] == 0
    assert sum(part["touches"] for part in report["sources"].values()) == report["touches"]
    assert curve["centre_mm_median"][0] < prior["centre_mm_median"][0]
    for found in report["methods"].values():
        assert all(0 <= found[name][0] <= 1 for name in ("mask_iou", "contact_iou", "coverage_90"))
    assert (out / "posteriors.png").exists()
    assert "simulated" in capsys.readouterr().out


def test_edges_of_masks_are_those_of_half_planes():
    at = ((np.arange(24) + 0.5) / 24 - 0.5) * PATCH_WINDOW
    x, y = np.meshgrid(at, at)
    find = jax.jit(edge_of)
    for degrees, offset in ((20.0, 2e-3), (160.0, -3e-3), (275.0, 0.0)):
        angle = np.radians(degrees)
        mask = np.cos(angle) * x + np.sin(angle) * y <= offset
        found, where, straight = find(jnp.float32(mask))
        assert abs(np.degrees(found) - degrees) < 2
        assert abs(where - offset) < 0.3e-3
        assert straight > 0.98
    assert find(jnp.float32(np.hypot(x, y) < 4e-3))[2] < 0.95  # a disk has no edge


def _recorded(name):
    """Three presses from above and one that met nothing."""
    made = random_touches.make(4, objects=(name,))
    placed = np.eye(4)
    placed[:3, 3] = 0.1, 0, 0
    down = placed @ np.diag([1.0, -1, -1, 1])
    down[2, 3] = 0.02
    touches = made.touches._replace(
        T_w_o=np.tile(placed, (4, 1, 1)),
        T_w_t=np.tile(down, (4, 1, 1)),
        travel=np.array([1e-3, 1e-3, 1e-3, np.nan]),
        code=np.array([ReturnCode.SKIN, ReturnCode.WRENCH, ReturnCode.SKIN, ReturnCode.AIR]),
        object=np.zeros(4, int),
    )
    return replace(made, touches=touches, source="simulated")


def test_no_more_space_is_carved_behind_recorded_contacts_than_was_surely_swept():
    recorded = _recorded("pyramid")
    assert swept_distance(recorded) == 40e-3
    assert swept_distance(replace(recorded, source="real")) == 2e-3
    merged = {"settings": '{"prepare": 0.03, "near": 0.01}; {"prepare": 5e-3}'}
    assert swept_distance(replace(recorded, source="real", meta=merged)) == 5e-3


@pytest.mark.full
def test_the_mesh_of_recorded_touches_may_be_recognised(tmp_path, capsys):
    out = tmp_path / "run"
    save_dataset(tmp_path / "touches.h5", _recorded("pyramid"))
    words = ["--dataset", str(tmp_path / "touches.h5"), "--preset", "debug", "--name", "felt"]
    assert main(["--out", str(out), *words]) == 0
    report = json.loads((out / "metrics.json").read_text())
    assert (report["source"], report["object"], report["contacts"], report["in_air"]) == ("simulated", "pyramid", 3, 1)
    assert 0 < report["surface_std_mm"]["median"] < 30
    felt = load_object(out / "felt.stl", "m")
    np.testing.assert_allclose(felt.mesh.vertices[:, 2].min(), 0, atol=1e-6)  # it stands as a loaded mesh does
    assert (out / "surface.png").exists()
    assert "next: python -m experiments.recognize live" in capsys.readouterr().out


def test_touches_of_a_data_set_are_taken_back_to_first_contact_in_the_objects_frame():
    dataset = _recorded("thing")
    found = read_touches(dataset, "thing")
    np.testing.assert_array_equal(found.hit, [True, True, True, False])
    np.testing.assert_allclose(found.T_o_t[:, :3, 3], [[0, 0, 0.021]] * 3 + [[0, 0, 0.02]], atol=1e-6)
    with pytest.raises(DataError, match="a surface needs 3 or more"):
        read_touches(dataset.select(np.array([0, 1, 3])), "thing")
    shifted = dataset.touches.T_w_t.copy()
    shifted[:2, 0, 3] += 20.0  # millimetres taken for metres
    far = replace(dataset, touches=dataset.touches._replace(T_w_t=shifted))
    with pytest.raises(DataError, match=r"contacts span 20\.00 m"):
        read_touches(far, "thing")
    with pytest.raises(DataError, match="holds no touch of other; pass --object with one of thing"):
        choose_object(dataset, "other", Path("DATA"))
