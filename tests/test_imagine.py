"""Predicted touches: their sites differ in kind, the words fit the patches, and the text fits the picture."""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from i2t import imagine
from i2t.objects import Mesh, contact_pose
from i2t.objects.catalogue import make_object
from i2t.patches.dimensions import PATCH_WINDOW, REACH
from i2t.rendering.render import prepare_surface, render_patch
from i2t.simulation.sites import collect_sites
from i2t.types import Board

X, Y = np.meshgrid(*2 * [((np.arange(48) + 0.5) / 48 - 0.5) * PATCH_WINDOW])


def kind(depth: np.ndarray) -> str:
    return imagine._kind(np.clip(depth, 0, REACH).astype(np.float32), PATCH_WINDOW, REACH)


def round_off(distance: np.ndarray, radius: float) -> np.ndarray:
    """Depth below the top of a cylinder or ball at a distance from its axis."""
    return np.where(distance < radius, radius - np.sqrt(np.maximum(radius**2 - distance**2, 0)), 1)


@pytest.mark.parametrize("turn", [0.0, 0.4, 1.3])
def test_words_describe_patches_however_the_skin_is_turned(turn):
    x, y = np.cos(turn) * X - np.sin(turn) * Y, np.sin(turn) * X + np.cos(turn) * Y
    assert kind(0.02 * X + 0.3e-3) == "flat"
    assert kind(np.where(x > 1e-3, 1, 0)) == "edge"
    assert kind(np.where(x > 2e-3, 1e-3 * 1.5, 0)) == "edge"  # a step
    assert kind(round_off(abs(x), 15e-3)) == "curved"
    assert kind(np.where(abs(x) < 1.2e-3, 0, 1)) == "ridge"
    assert kind(round_off(np.hypot(x, y), 8e-3)) == "tip"
    assert kind(np.where(np.hypot(x, y) < 3e-3, 0, 1)) == "tip"


def patch_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Root mean square difference (m) at the best of four turns, so that a turned skin is no difference."""
    return min(float(np.sqrt(np.mean((a - np.rot90(b, k)) ** 2))) for k in range(4))


@pytest.mark.full
def test_chosen_sites_differ_more_than_random_ones():
    surface = prepare_surface(make_object("hammer").mesh)
    T_o_t = collect_sites(jax.random.key(0), surface, 64)
    patches = np.stack([render_patch(surface, T).depth for T in T_o_t])
    kinds = [kind(patch) for patch in patches]
    chosen = imagine._most_different(patches, kinds, T_o_t[:, :3, 3], 4)
    assert len({kinds[i] for i in chosen}) == 4
    least = [
        min(patch_distance(patches[i], patches[j]) for i, j in combinations(sites, 2))
        for sites in (chosen, *np.random.default_rng(0).permutation(64).reshape(-1, 4))
    ]
    assert least[0] > max(least[1:])
    assert imagine._most_different(patches, kinds, T_o_t[:, :3, 3], 4) == chosen
    everything = imagine._most_different(patches, kinds, T_o_t[:, :3, 3], 64)
    assert sorted(everything) == list(range(64))


def test_equal_patches_are_spread_over_the_object():
    points = np.array([[0.0, 0, 0], [1e-3, 0, 0], [40e-3, 0, 0], [20e-3, 0, 0]])
    assert imagine._most_different(np.zeros((4, 48, 48)), ["flat"] * 4, points, 3) == [0, 2, 3]


def test_the_text_names_chip_and_direction_as_drawn():
    """The chip's x axis is the tool's -z, so that a positive x points into the skin."""
    turned = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    board = Board(np.zeros((2, 3)), np.stack([np.eye(3), turned]))
    mean, std = np.array([1, 2, 3, 9, 0, 0.0]), np.array([1, 1, 1, 4, 1, 1.0])
    assert imagine._strongest(board, mean, std) == "chip 1 changes most, by 9.0 +- 4.0 uT into the skin"
    assert imagine._strongest(board, -mean, std) == "chip 1 changes most, by 9.0 +- 4.0 uT out of the skin"
    one = Board(np.zeros((1, 3)), np.eye(3)[None])
    assert imagine._strongest(one, mean[:3] * [1, -9, 1], std[:3]) == (
        "chip 0 changes most, by -18.0 +- 1.0 uT along y"
    )


@pytest.mark.full
@pytest.mark.parametrize("edge", [6.0, 60.0])
def test_a_box_is_drawn(edge, tmp_path, capsys):
    """A box of any size, though all its faces are flat, and one site more than kinds of patches."""
    trimesh.creation.box((edge, edge, edge)).export(tmp_path / "box.stl")
    out = tmp_path / "touches.png"
    assert imagine.main([str(tmp_path / "box.stl"), "--unit", "mm", "--sites", "3", "--out", str(out)]) == 0
    assert out.stat().st_size > 10_000
    placement, *lines = capsys.readouterr().out.splitlines()
    assert placement.startswith(f"box: the mesh was moved by 0.00, 0.00, {edge / 2:.2f} mm from its file's frame")
    assert [line.split(" (")[0] for line in lines] == ["touch 1", "touch 2", "touch 3", f"wrote {out}"]


def kind_on(mesh: trimesh.Trimesh, point: tuple[float, float, float]) -> str:
    own = Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32))
    patch = jax.jit(render_patch)(prepare_surface(own), np.float32(contact_pose(own, point, roll=0.3)))
    return imagine._kind(np.asarray(patch.depth), PATCH_WINDOW, REACH)


def test_straight_steps_are_edges_and_round_surfaces_are_not():
    """Also steps near the rim of the patch, and those of an object of several bodies."""
    plate, wall = trimesh.creation.box((60e-3, 40e-3, 10e-3)), trimesh.creation.box((10e-3, 40e-3, 40e-3))
    wall.apply_translation([-25e-3, 0, 25e-3])
    bracket = trimesh.util.concatenate([plate, wall])
    for mesh in (plate, bracket):
        assert kind_on(mesh, (5e-3, 0, 5e-3)) == "flat"
        for y in (-14e-3, -16e-3, -19e-3):
            assert kind_on(mesh, (-5e-3, y, 5e-3)) == "edge"
        assert kind_on(mesh, (25e-3, 1e-3, 5e-3)) == "edge"
    star = make_object("star").mesh
    assert kind_on(trimesh.Trimesh(star.vertices, star.faces, process=False), (3e-3, 18e-3, 30e-3)) == "edge"
    lying = trimesh.creation.cylinder(15e-3, 60e-3, sections=128)
    assert [kind_on(lying, (15e-3, 0, z)) for z in (0, 25e-3, 29e-3)] == ["curved", "edge", "edge"]
    for radius, words in ((8e-3, {"tip"}), (30e-3, {"curved"})):
        ball = trimesh.creation.icosphere(4, radius)
        assert kind_on(ball, tuple(ball.triangles_center[7])) in words


def by(load: str) -> Any:
    return SimpleNamespace(load=load, default_travel=0.33e-3)


def test_the_load_is_the_one_that_the_predictor_uses(capsys):
    args = imagine.ImagineArgs(model="runs/fit")
    assert imagine._load(args, by("force")) == ({"force": 1.0}, "1 N")
    given, words = imagine._load(args, by("travel"))
    assert (given["travel"], words) == (pytest.approx(0.33e-3), "0.33 mm travel")
    assert capsys.readouterr().out.endswith("was fitted to presses by travel; all touches have 0.33 mm travel\n")
    assert imagine._load(replace(args, travel=0.5), by("travel"))[0]["travel"] == pytest.approx(0.5e-3)
    with pytest.raises(ValueError, match="--force: the predictor of runs/fit was fitted to presses by travel; give"):
        imagine._load(replace(args, force=1.0), by("travel"))
    with pytest.raises(ValueError, match="--travel: the predictor of runs/fit was fitted to presses by force; give"):
        imagine._load(replace(args, travel=0.5), by("force"))


def test_a_place_gives_one_touch_or_is_refused_in_one_sentence():
    box = trimesh.creation.box((40e-3, 40e-3, 40e-3))
    mesh = Mesh(np.asarray(box.vertices), np.asarray(box.faces, np.int32))
    touches: Any = SimpleNamespace(render_touches=lambda surface, T_o_t: T_o_t.shape)
    T_o_t, seen = imagine._touch_at((3.0, -4.0, 20.0), touches, prepare_surface(mesh), mesh)
    assert seen == (1, 4, 4)
    np.testing.assert_allclose(T_o_t[0, :3, 2:].T, [[0, 0, -1], [3e-3, -4e-3, 20e-3]], atol=1e-9)
    with pytest.raises(ValueError, match=r"^--at 3 -4 25: lies 5 mm off the surface, .*; give another place .* in mm"):
        imagine._touch_at((3.0, -4.0, 25.0), touches, prepare_surface(mesh), mesh)
