"""The catalogue against closed forms; every object is closed, outward, on the table and of a plausible size."""

import hashlib

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from i2t.objects import (
    HAND_TOOLS,
    NAMES,
    PRIMITIVES,
    STAMPS,
    Mesh,
    make_object,
    primitives,
    random_object,
    surrogate_unknown,
    transform_mesh,
)
from i2t.objects.drawing import segments

# Outlines pass through a polygon clipper that rounds to 1e-8 mm, so lengths of 10 mm and more are exact to 1e-9, areas
# to twice and volumes to three times that.
EXACT = 3e-9


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def size(mesh: Mesh) -> np.ndarray:
    return np.ptp(mesh.vertices, axis=0)


def check_shape(mesh: Mesh) -> None:
    whole = solid(mesh)
    assert whole.is_watertight
    assert whole.is_winding_consistent
    assert whole.body_count == 1
    assert whole.volume > 0  # outward
    assert mesh.vertices.dtype == np.float64
    assert mesh.faces.dtype == np.int32
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    np.testing.assert_allclose((low + high)[:2], 0, atol=1e-15)  # sums of two rounded halves of at most 0.3 m
    assert low[2] == 0
    assert len(mesh.faces) <= 4096  # a size class of the renderer


FAMILIES = {"primitive": PRIMITIVES, "stamp": STAMPS, "tool": HAND_TOOLS}


def test_the_catalogue_has_not_changed_in_any_bit():
    digest = hashlib.sha256()
    for name in NAMES:
        for values in make_object(name).mesh:
            digest.update(np.ascontiguousarray(values).tobytes())
    assert digest.hexdigest() == "a38ddd6d3640aaf41c315e27f5f3d937d1d47061039b5fe62036f3b1c285c1d0"


def test_every_catalogue_object_is_closed_outward_on_the_table_and_of_its_family():
    assert PRIMITIVES[:6] == ("hexagon", "parallelogram", "star", "square", "flower", "cylinder")
    assert len(set(NAMES)) == len(NAMES) == sum(map(len, FAMILIES.values()))
    for family, names in FAMILIES.items():
        for thing in map(make_object, names):
            assert thing.name in names
            assert thing.family == family
            check_shape(thing.mesh)
    with pytest.raises(ValueError, match=r"'spoon'.*hexagon"):
        make_object("spoon")


H = 30e-3  # m, the prisms' height


@pytest.mark.parametrize(
    ("mesh", "volume", "extent"),
    [
        (primitives.polygon(6, 60e-3, H), 3 * 3**0.5 / 8 * 60e-3**2 * H, [60e-3, 30e-3 * 3**0.5, H]),
        (primitives.polygon(3, 64e-3, H), 3 * 3**0.5 / 16 * 64e-3**2 * H, None),
        (primitives.parallelogram(50e-3, 40e-3, 20e-3, H), 50e-3 * 40e-3 * H, [70e-3, 40e-3, H]),
        (primitives.star(5, 70e-3, 0.5, H), 5 * 35e-3 * 17.5e-3 * np.sin(np.pi / 5) * H, None),
        (primitives.cross(60e-3, 22e-3, H), (2 * 60e-3 - 22e-3) * 22e-3 * H, [60e-3, 60e-3, H]),
        (primitives.pyramid(60e-3, 15e-3, 36e-3), 12e-3 * (60e-3**2 + 15e-3**2 + 60e-3 * 15e-3), [60e-3, 60e-3, 36e-3]),
        (primitives.wedge(60e-3, 50e-3, 10e-3, 35e-3), 60e-3 * 50e-3 * (10e-3 + 35e-3) / 2, [60e-3, 50e-3, 35e-3]),
        (primitives.stairs(3, 60e-3, 50e-3, 36e-3), 60e-3 * 50e-3 * 36e-3 * (1 + 2 + 3) / 9, [60e-3, 50e-3, 36e-3]),
        (primitives.ridge(60e-3, 50e-3, 20e-3, 12e-3), None, [60e-3, 50e-3, 32e-3]),
        (primitives.ellipsoid(70e-3, 50e-3, 40e-3), None, [70e-3, 50e-3, 40e-3]),
    ],
)
def test_volumes_and_extents_of_solids(mesh, volume, extent):
    check_shape(mesh)
    if volume:
        assert solid(mesh).volume == pytest.approx(volume, rel=EXACT)
    if extent:
        np.testing.assert_allclose(size(mesh), extent, rtol=EXACT)


def test_round_solids_have_their_corners_on_the_surface_and_their_chords_within_the_sagitta():
    cylinder = primitives.cylinder(60e-3, H)
    rim = np.linalg.norm(cylinder.vertices[:, :2], axis=1)
    np.testing.assert_allclose(rim, 30e-3, rtol=EXACT)
    n = segments(30.0)
    assert solid(cylinder).volume == pytest.approx(n / 2 * 30e-3**2 * np.sin(2 * np.pi / n) * H, rel=EXACT)
    assert 30 * (1 - np.cos(np.pi / n)) <= 0.03  # mm

    cone = primitives.cone(60e-3, 20e-3, 35e-3)
    radius = 30e-3 + (10e-3 - 30e-3) * cone.vertices[:, 2] / 35e-3
    np.testing.assert_allclose(np.linalg.norm(cone.vertices[:, :2], axis=1), radius, rtol=EXACT)

    dome = primitives.dome(60e-3).vertices
    shell = dome[dome[:, 2] > 0]
    np.testing.assert_allclose(np.linalg.norm(shell, axis=1), 30e-3, rtol=EXACT)

    ellipsoid = primitives.ellipsoid(70e-3, 50e-3, 40e-3).vertices - [0, 0, 20e-3]
    np.testing.assert_allclose(np.linalg.norm(ellipsoid / [35e-3, 25e-3, 20e-3], axis=1), 1, rtol=EXACT)

    torus = primitives.torus(68e-3, 20e-3).vertices
    upper = torus[torus[:, 2] > 1e-9]
    tube = np.hypot(np.linalg.norm(upper[:, :2], axis=1) - 24e-3, upper[:, 2])
    np.testing.assert_allclose(tube, 10e-3, rtol=EXACT)

    # An even flower is symmetric, so settling does not move it and its outline stays centred.
    flower = primitives.flower(6, 70e-3, 0.15, H).vertices
    outline = 35e-3 * (1 + 0.15 * np.cos(6 * np.arctan2(flower[:, 1], flower[:, 0]))) / 1.15
    # 6 * 0.15 more for the angle's own rounding
    np.testing.assert_allclose(np.linalg.norm(flower[:, :2], axis=1), outline, rtol=4 * EXACT)


def test_stamps_are_reliefs_within_10_mm_and_3_5_mm_high():
    areas = {
        "stamp-T": 10 * 3 + 7 * 3,
        "stamp-angle": 10 * 3 + 7 * 3,
        "stamp-cross": 2 * 10 * 3 - 3 * 3,
        "stamp-triangle": 3**0.5 / 4 * 10**2,
        "stamp-circle": segments(5.0) / 2 * 5**2 * np.sin(2 * np.pi / segments(5.0)),
    }
    assert set(areas) == set(STAMPS)
    for name, area in areas.items():
        mesh = make_object(name).mesh
        np.testing.assert_allclose(size(mesh), [20e-3, 20e-3, 8.5e-3], rtol=EXACT)
        relief = mesh.vertices[mesh.vertices[:, 2] > 5.5e-3]
        assert (np.ptp(relief[:, :2], axis=0) <= 10e-3 * (1 + EXACT)).all()
        # All of the volume above the base is the relief.
        assert solid(mesh).volume == pytest.approx(20e-3 * 20e-3 * 5e-3 + area * 1e-6 * 3.5e-3, rel=EXACT)


SIZES = {  # mm, of primitives wider than the skin, and of such tools in a shop
    **dict.fromkeys(PRIMITIVES, ((40, 72), (40, 72), (10, 45))),
    "cutter": ((140, 200), (18, 35), (12, 25)),
    "screwdriver": ((150, 250), (25, 40), (25, 40)),
    "spanner": ((150, 250), (25, 50), (4, 12)),
    "hammer": ((250, 330), (90, 140), (20, 40)),
    "marker": ((110, 150), (14, 25), (14, 25)),
    "pliers": ((150, 220), (40, 70), (10, 25)),
    "scissors": ((150, 230), (60, 100), (5, 15)),
}


def test_primitives_and_tools_have_their_sizes():
    assert set(SIZES) == {*PRIMITIVES, *HAND_TOOLS}
    for name, ranges in SIZES.items():
        across = 1e3 * size(make_object(name).mesh)
        assert all(low <= value <= high for value, (low, high) in zip(across, ranges, strict=True)), name
    assert size(primitives.blob(0))[2] == pytest.approx(30e-3)  # which is none of the catalogue


def test_random_objects():
    drawn = [random_object(seed) for seed in range(60)]
    for thing in drawn:
        check_shape(thing.mesh)
        assert min(size(thing.mesh)[:2]) >= 20e-3
        assert max(size(thing.mesh)) <= 75e-3
        assert thing.family == "primitive"
    # Each family; one is missed with p = 15 (14/15)^60 < .25.
    assert len({thing.name.rsplit("-", 1)[0] for thing in drawn}) == 15
    assert len({(len(thing.mesh.faces), *size(thing.mesh).round(9)) for thing in drawn}) == 60
    np.testing.assert_array_equal(random_object(7).mesh.vertices, drawn[7].mesh.vertices)


def test_surrogate_unknowns_resemble_known_objects_but_differ_from_them():
    known_meshes = [make_object("square").mesh, make_object("hammer").mesh]
    drawn = [surrogate_unknown(known_meshes, seed).mesh for seed in range(60)]
    heights = np.array([size(mesh)[2] for mesh in drawn])
    for mesh in drawn:
        check_shape(mesh)
    apart = [min(np.abs(size(mesh) - size(other)).max() for other in known_meshes) for mesh in drawn]
    assert np.mean(np.array(apart) > 4e-3) > 0.9  # by a seventh of a square; a random outline may come near one
    same = np.isclose(heights[:, None], [30e-3, 26e-3], rtol=1e-6).any(1)
    assert 15 < same.sum() < 45  # half of them, within 4 standard deviations
    np.testing.assert_array_equal(surrogate_unknown(known_meshes, 3).mesh.vertices, drawn[3].vertices)


@settings(deadline=None, max_examples=15)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_moving_a_mesh_keeps_its_volume_and_its_outside(seed, mirrored):
    mesh = make_object("star").mesh
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix() @ np.diag([1, 1, -1 if mirrored else 1])
    T[:3, 3] = rng.uniform(-1, 1, 3)
    moved = transform_mesh(mesh, T)
    np.testing.assert_allclose(
        np.linalg.norm(moved.vertices - T[:3, 3], axis=1), np.linalg.norm(mesh.vertices, axis=1), atol=1e-14
    )
    # Volumes sum triple products of coordinates up to 2 m: 36 faces x 8 m^3 x 2^-52 = 6e-14 m^3.
    assert solid(moved).volume == pytest.approx(solid(mesh).volume, abs=1e-13)
