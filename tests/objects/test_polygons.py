"""Triangulation: the same area, every side once, no new vertices, and no polygon that crosses itself."""

import time
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from i2t.errors import DataError
from i2t.objects.polygons import strip_triangles, triangulate

# A section of a channel of 30 x 30 mm with a slot of 12 x 21 mm: 648 mm^2.
CHANNEL = [(0, 0), (30, 0), (30, 30), (21, 30), (21, 9), (9, 9), (9, 30), (0, 30)]


def cut(points, corners=None):
    """Triangles of one polygon."""
    corners = np.arange(len(points)) if corners is None else np.asarray(corners)
    return triangulate(np.asarray(points, float), corners, np.array([len(corners)]), "a.obj: face {}".format)


def flat_area(points):
    x, y = np.asarray(points, float).T
    return (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2


def in_space(points, seed=0):
    return np.c_[points, np.zeros(len(points))] @ Rotation.random(rng=seed).as_matrix().T + 7.0 * seed


def check(vertices, corners, area):
    """Check that the triangles have the polygon's area, one orientation, and only the polygon's sides as open edges."""
    faces = cut(vertices, corners)
    a, b, c = np.moveaxis(np.asarray(vertices)[faces], 1, 0)
    vectors = np.cross(b - a, c - a) / 2
    sizes = np.linalg.norm(vectors, axis=1)
    assert sizes.sum() == pytest.approx(area, rel=1e-5)
    assert np.linalg.norm(vectors.sum(0)) == pytest.approx(area, rel=1e-5)
    assert (sizes > 0).all()
    edges = Counter((u, v) for face in faces.tolist() for u, v in zip(face, face[1:] + face[:1], strict=True))
    edges.update(zip(np.roll(corners, -1).tolist(), list(corners), strict=True))  # the outside, the other way round
    assert all(edges[v, u] == count for (u, v), count in edges.items())


def crossing(points):
    """Two sides that cross, or None."""
    a, b = points, np.roll(points, -1, 0)

    def side(p, q, r):
        return np.cross(np.append(q - p, 0), np.append(r - p, 0))[2]

    for i in range(len(a)):
        for j in range(i + 1, len(a)):
            if (
                side(a[i], b[i], a[j]) * side(a[i], b[i], b[j]) < 0
                and side(a[j], b[j], a[i]) * side(a[j], b[j], b[i]) < 0
            ):
                return i, j
    return None


def simple_polygon(rng, size):
    """Random corners in an order without crossings: each crossing is undone by reversing the corners in between."""
    points = 50 * rng.random((size, 2))
    while pair := crossing(points):
        i, j = pair
        points[i + 1 : j + 1] = points[i + 1 : j + 1][::-1]
    return points


@given(st.integers(0, 2**32 - 1), st.integers(4, 12), st.booleans(), st.booleans())
@settings(max_examples=25, deadline=None)
def test_a_simple_polygon_keeps_its_area_and_its_sides(seed, size, turned, single):
    rng = np.random.default_rng(seed)
    points = simple_polygon(rng, size)
    points = np.concatenate([
        p + np.sort(np.append(rng.random(rng.integers(3)), 0))[:, None] * (q - p)  # corners on straight sides
        for p, q in zip(points, np.roll(points, -1, 0), strict=True)
    ])  # fmt: skip
    vertices = in_space(points[::-1] if turned else points, seed % 10)
    vertices = vertices.astype(np.float32).astype(float) if single else vertices
    check(vertices, np.roll(np.arange(len(points)), rng.integers(len(points))), abs(flat_area(points)))


@pytest.mark.parametrize("first", range(8))
@pytest.mark.parametrize("step", [1, -1])
def test_a_channel_keeps_its_slot_from_any_first_corner(first, step):
    check(in_space(CHANNEL, 3), np.roll(np.arange(8), first)[::step], 648)


def test_holes_joined_by_a_bridge_stay_open():
    outer = [(0, 0), (40, 0), (40, 30), (0, 30)]
    hole = [(10, 10), (10, 20), (20, 20), (20, 10)]  # the other way round
    other = [(25, 10), (25, 20), (35, 20), (35, 10)]
    loop = [0, 4, 5, 6, 8, 9, 10, 11, 8, 6, 7, 4, 0, 1, 2, 3]
    vertices = in_space(outer + hole + other, 2)
    area = 40 * 30 - 2 * 100
    for first in range(len(loop)):
        check(vertices, np.roll(loop, first), area)
        check(vertices, np.roll(loop, first)[::-1], area)
    faces = cut(vertices[loop])  # each corner a vertex of its own
    assert np.linalg.norm(np.cross(*np.diff(vertices[loop][faces], axis=1).swapaxes(0, 1)), axis=1).sum() / 2 == (
        pytest.approx(area)
    )


def test_a_polygon_may_touch_itself_at_a_corner():
    vertices = in_space([(0, 0), (5, 5), (10, 0), (10, 10), (0, 10)], 1)
    check(vertices, np.array([0, 1, 2, 3, 1, 4]), 50)


SPIKES = {
    "outward": [(10, 5), (20, 5), (10, 5)],
    "inward": [(10, 5), (4, 5), (10, 5)],
    "of several corners": [(10, 5), (14, 5), (20, 5), (14, 5), (10, 5)],
    "out in two steps and back in one": [(10, 5), (14, 5), (20, 5), (10, 5)],
    "forked": [(10, 5), (20, 5), (20, 8), (20, 5), (10, 5)],
}


@pytest.mark.parametrize("spike", SPIKES)
@pytest.mark.parametrize("turned", [False, True])
def test_spikes_without_a_width_have_no_area(spike, turned):
    points = np.array([(0, 0), (10, 0), *SPIKES[spike], (10, 10), (0, 10)], float)
    for first in range(len(points)):
        loop = np.roll(points[::-1] if turned else points, first, 0)
        _, at, shared = np.unique(loop, axis=0, return_index=True, return_inverse=True)
        for corners in (np.arange(len(loop)), at[shared.ravel()]):  # as vertices of their own, and as the same ones
            space = in_space(loop, seed=first)
            a, b, c = np.moveaxis(space[cut(space, corners)], 1, 0)
            vectors = np.cross(b - a, c - a) / 2
            assert np.linalg.norm(vectors, axis=1).sum() == pytest.approx(100, rel=1e-5)
            assert np.linalg.norm(vectors.sum(0)) == pytest.approx(100, rel=1e-5)


def test_a_narrow_polygon_far_from_the_origin_keeps_its_area():
    for height in (0.2, 1e-3):
        points = [(0, 0), (30, 0), (30, height), (20, height), (15, height / 2), (9, height), (0, height)]
        vertices = in_space(points, 1) + np.array([5e3, 0, 0])
        a, b, c = np.moveaxis(vertices[cut(vertices)], 1, 0)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        assert area == pytest.approx(abs(flat_area(points)), rel=1e-3)


def test_a_polygon_that_bends_a_little_out_of_its_plane_is_cut():
    rng = np.random.default_rng(0)
    vertices = in_space(CHANNEL, 1) + 0.05 * rng.normal(size=(8, 3))
    a, b, c = np.moveaxis(vertices[cut(vertices)], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(648, rel=0.02)


def test_repeated_corners_are_merged_and_polygons_without_area_are_kept():
    square = in_space([(0, 0), (1, 0), (1, 1), (0, 1)])
    assert len(cut(square, [0, 1, 1, 2, 3, 3])) == 2
    assert cut(square, [0, 1, 2, 2]).tolist() == [[0, 1, 2]]
    for corners in ([0, 0, 0, 0], [0, 1, 0, 1], [0, 1, 2, 1]):
        faces = cut(square, corners)
        assert len(faces) == 1
        assert len(set(faces[0].tolist())) < 3
    line = in_space([(0, 0), (1, 0), (2, 0), (3, 0)])
    a, b, c = np.moveaxis(line[cut(line)], 1, 0)
    np.testing.assert_allclose(np.cross(b - a, c - a), 0, atol=1e-9)


@pytest.mark.parametrize(
    "points",
    [
        [(0, 0), (10, 10), (10, 0), (0, 10)],  # a bow tie, whose area is zero
        [(0, 0), (10, 10), (10, 0), (0, 14)],
        [(np.cos(a), np.sin(a)) for a in 4 * np.pi / 5 * np.arange(5)],  # a pentagram: every corner turns left
        [(0, 0), (20, 0), (20, 10), (5, 10), (5, -5), (0, -5)],
        [(0, 0), (5, 5), (10, 10), (10, 0), (5, 5), (0, 10)],  # two halves of opposite turns that share a corner
        [(0, 0), (5, 5), (11, 11), (11, -1), (5, 5), (0, 10)],
    ],
)
def test_a_polygon_that_crosses_itself_is_refused_by_name(points):
    for first in range(len(points)):
        with pytest.raises(DataError, match=r"a.obj: face 0 has . corners and crosses itself; repair it"):
            cut(in_space(points, 1), np.roll(np.arange(len(points)), first))


def test_quads_are_cut_along_the_diagonal_that_is_inside():
    dart = in_space([(0, 0), (10, -10), (2, 0), (10, 10)], 1)
    for first in range(4):
        check(dart, np.roll(np.arange(4), first), 20)
    flat = in_space([(0, 0), (5, 0), (10, 0), (0, 10)], 1)  # a corner on a straight side
    for first in range(4):
        check(flat, np.roll(np.arange(4), first), 50)


def test_many_corners_and_many_polygons_take_seconds_or_are_refused():
    size = 600
    comb = np.c_[np.arange(size), np.where(np.arange(size) % 2, 1.0, 50.0)]
    comb = np.concatenate([comb, [[size, -10], [-1, -10]]])[::-1]
    begun = time.process_time()
    check(in_space(comb), np.arange(len(comb)), flat_area(comb))
    quads = np.arange(4 * 50_000).reshape(-1, 4)
    vertices = np.tile([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]], (50_000, 1))
    faces = triangulate(vertices, quads.reshape(-1), np.full(50_000, 4), str)
    np.testing.assert_array_equal(faces[:2], [[0, 1, 2], [0, 2, 3]])
    assert time.process_time() - begun < 5
    with pytest.raises(DataError, match=r"face 0 and others are not convex and have 602 corners"):
        triangulate(in_space(comb), np.tile(np.arange(602), 300), np.full(300, 602), "face {}".format)


def test_every_second_triangle_of_a_strip_is_turned():
    assert strip_triangles(np.array([0, 1, 2, 3])).tolist() == [[0, 1, 2], [2, 1, 3]]
    assert strip_triangles(np.array([0, 1, 2, 2, 3, 3, 4, 5])).tolist() == [[0, 1, 2], [4, 3, 5]]
    assert strip_triangles(np.array([0, 1])).shape == (0, 3)
