"""Cleaning of meshes: its counts, the bodies and walls that it keeps, and the outside of each body."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from i2t.objects import clean_mesh, make_object
from i2t.objects.solids import Mesh

BOX = (0.06, 0.04, 0.02)  # m


def box(extents=BOX, at=(0.0, 0.0, 0.0)) -> Mesh:
    return plain(trimesh.creation.box(extents).apply_translation(at))


def turned(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[:, ::-1])


def mirrored(mesh: Mesh, axis: int = 0) -> Mesh:
    """The mirror image without reversed triangles, so that they face inward."""
    return Mesh(mesh.vertices * np.where(np.arange(3) == axis, -1, 1), mesh.faces)


def joined(*parts: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(p.vertices) for p in parts)])
    faces = [p.faces + s for p, s in zip(parts, starts, strict=False)]
    return Mesh(np.concatenate([p.vertices for p in parts]), np.concatenate(faces).astype(np.int32))


def plain(mesh: trimesh.Trimesh) -> Mesh:
    return Mesh(np.array(mesh.vertices), np.array(mesh.faces, np.int32))


def whole(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def test_cleaning_counts_its_changes():
    rng = np.random.default_rng(0)
    good = plain(trimesh.creation.icosphere(2, 0.03))
    speck = plain(trimesh.creation.box((2e-3, 2e-3, 2e-3)))
    soup = Mesh(good.vertices[good.faces.ravel()], np.arange(3 * len(good.faces), dtype=np.int32).reshape(-1, 3))
    turned = rng.permutation(len(good.faces))[:70]
    soup.faces[turned] = soup.faces[turned][:, ::-1]
    extra = np.array([[0, 0, 1], [0, 1, 2], [3, 4, 5], [3, 5, 4]], np.int32)  # one of no area, three repeated
    dirty = joined(Mesh(soup.vertices, np.concatenate([soup.faces, extra])), speck)
    mesh, _, report = clean_mesh(dirty, "dirty.stl", largest_piece=True)
    area = trimesh.creation.icosphere(2, 0.03).area
    assert report.area_dropped == pytest.approx(24e-6 / (24e-6 + area))
    assert (report.faces_read, report.faces, report.watertight) == (320 + 4 + 12, 320, True)
    assert (report.degenerate, report.repeated, report.pieces_dropped) == (1, 3, 1)
    assert report.vertices_merged == 3 * 320 - len(good.vertices)
    assert report.turned in (70, 71)  # 71 where the second repeat was the one turned round
    assert whole(mesh).volume == pytest.approx(whole(good).volume, rel=1e-6)  # vertices merge within 1e-8 of 0.03 m
    assert "dirty.stl: 320 of 336 faces" in str(report)
    both, _, report = clean_mesh(dirty)
    assert (len(both.faces), report.pieces_dropped) == (332, 0)
    assert whole(both).volume == pytest.approx(whole(good).volume + 8e-9, rel=1e-6)


def test_cleaning_leaves_a_clean_mesh_and_turns_an_inverted_one():
    star = make_object("star").mesh
    mesh, _, report = clean_mesh(star, "star")
    np.testing.assert_array_equal(mesh.faces, star.faces)
    np.testing.assert_array_equal(mesh.vertices, star.vertices)
    assert "nothing to clean" in str(report)
    mesh, _, report = clean_mesh(Mesh(star.vertices, star.faces[:, ::-1]))
    assert report.turned == len(star.faces)
    assert whole(mesh).volume == pytest.approx(whole(star).volume)


def test_holes_are_kept_fins_are_dropped_and_two_sided_sheets_keep_one_side():
    thing = plain(box())
    mesh, _, report = clean_mesh(Mesh(thing.vertices, thing.faces[1:]))
    assert (len(mesh.faces), report.open_edges, report.watertight) == (11, 3, False)
    assert "open at 3 edges" in str(report)
    thing = plain(trimesh.creation.icosphere(2, 0.03))
    a, b = thing.faces[0, :2]
    tip = len(thing.vertices)
    vertices = np.concatenate([thing.vertices, thing.vertices[[a]] * 1.01])
    fin = np.array([[a, b, tip], [b, a, tip]], np.int32)
    mesh, _, report = clean_mesh(Mesh(vertices, np.concatenate([thing.faces, fin])))
    assert (len(mesh.faces), report.repeated, report.watertight) == (len(thing.faces), 2, True)
    sheet = Mesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.0]]), np.array([[0, 1, 2], [2, 1, 0]], np.int32))
    mesh, _, report = clean_mesh(sheet)
    assert (len(mesh.faces), report.repeated) == (1, 1)


def without(mesh: Mesh, normal: tuple[float, float, float]) -> Mesh:
    """A mesh without the faces whose normal points in one direction."""
    return Mesh(mesh.vertices, mesh.faces[whole(mesh).face_normals @ normal < 1 - 1e-6])


def half_dome() -> Mesh:
    """The half of a dome at x >= 0, with its wall at x = 0."""
    cut = trimesh.creation.icosphere(3, 0.03).slice_plane([0, 0, 0], [1, 0, 0], cap=True)
    return plain(cut.slice_plane([0, 0, 0], [0, 0, 1], cap=True))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("half", [box((0.03, 0.04, 0.02), (0.015, 0, 0)), half_dome()], ids=["box", "dome"])
def test_a_mirrored_half_is_turned_outward_and_the_wall_between_is_dropped(half, seed):
    turn = Rotation.random(random_state=seed).as_matrix()
    both = joined(half, mirrored(half))
    both = Mesh(both.vertices @ turn.T + 0.1, both.faces)
    order = np.random.default_rng(seed).permutation(len(both.faces))
    for given in (both, turned(both)):
        mesh, obstacles, report = clean_mesh(Mesh(given.vertices, given.faces[order]))
        assert whole(mesh).volume == pytest.approx(2 * whole(half).volume, rel=1e-6)
        assert whole(mesh).is_watertight
        assert whole(mesh).is_winding_consistent
        assert report.watertight
        assert report.repeated > 0
        assert not len(obstacles.faces)


def test_four_quarters_that_meet_lose_all_walls_between_them():
    quarter = box((0.03, 0.02, 0.02), (0.015, 0.01, 0.01))
    half = joined(quarter, mirrored(quarter, 0))
    mesh, _, report = clean_mesh(joined(half, mirrored(half, 1)))
    assert whole(mesh).volume == pytest.approx(4 * whole(quarter).volume)
    assert whole(mesh).area == pytest.approx(2 * (0.06 * 0.04 + 0.06 * 0.02 + 0.04 * 0.02))
    assert report.watertight


@pytest.mark.parametrize("seed", range(4))
def test_a_wall_that_two_bodies_triangulate_differently_leaves_both_outward(seed):
    right, left = box((0.03, 0.04, 0.02), (0.015, 0, 0)), mirrored(box((0.03, 0.04, 0.02), (0.015, 0, 0)))
    wall = np.flatnonzero(np.isclose(left.vertices[:, 0], 0))
    side = np.isclose(left.vertices[left.faces][..., 0], 0).all(1)
    other_diagonal = wall[np.array([[0, 2, 3], [0, 3, 1]])]  # turned inward, as the rest of that half
    left = Mesh(left.vertices, np.concatenate([left.faces[~side], other_diagonal]).astype(np.int32))
    turn = Rotation.random(random_state=seed).as_matrix()
    both = joined(right, left)
    mesh, _, _ = clean_mesh(Mesh(both.vertices @ turn.T, both.faces))
    assert whole(mesh).volume == pytest.approx(2 * whole(right).volume)
    outward = np.sum(whole(mesh).face_normals * whole(mesh).triangles_center, 1)
    assert (outward > -1e-9).all()


@pytest.mark.parametrize("inverted", [(0,), (1,), (0, 1)])
def test_bodies_that_overlap_or_share_a_face_are_judged_separately(inverted):
    ball, cube = plain(trimesh.creation.icosphere(3, 0.03)), box((0.036, 0.036, 0.036))
    plate, peg = box((0.06, 0.06, 0.01), (0, 0, -0.005)), box((0.02, 0.02, 0.02), (0, 0, 0.01))
    for bodies in ((ball, cube), (plate, peg)):  # corners of the cube stand out of the ball
        given = joined(*(turned(body) if i in inverted else body for i, body in enumerate(bodies)))
        mesh, _, report = clean_mesh(given)
        assert whole(mesh).volume == pytest.approx(sum(whole(body).volume for body in bodies))
        assert report.turned == sum(len(bodies[i].faces) for i in inverted)


@pytest.mark.parametrize("inverted", [False, True])
def test_unconnected_faces_are_turned_together_or_not_at_all(inverted):
    """A pipe whose outer and inner walls and rims are surfaces of their own, a micrometre apart."""
    pipe = trimesh.creation.annulus(0.017, 0.02, 0.06)
    faces = [pipe.faces[facet] for facet in pipe.facets]
    faces.append(np.delete(pipe.faces, np.concatenate(pipe.facets), axis=0))
    parts = [Mesh(pipe.vertices + 1e-6 * i, group) for i, group in enumerate(faces) if len(group)]
    given = joined(*parts)
    report = clean_mesh(turned(given) if inverted else given).report
    assert report.turned == (len(given.faces) if inverted else 0)


def test_a_dish_next_to_a_ball_scanned_from_above_is_not_turned():
    bowl = plain(trimesh.creation.icosphere(3, 0.03).slice_plane([0, 0, 0], [0, 0, -1]))
    ball = plain(trimesh.creation.icosphere(3, 0.02).apply_translation([0.1, 0, 0]))
    assert clean_mesh(joined(turned(bowl), ball)).report.turned == 0


@pytest.mark.parametrize("apart", [1e-4, 0.02])
def test_separate_bodies_are_judged_separately(apart):
    right = box((0.03, 0.04, 0.02), (0.015 + apart / 2, 0, 0))
    mesh, _, report = clean_mesh(joined(right, mirrored(right), turned(box((0.01, 0.01, 0.01), (0, 0, 0.05)))))
    assert whole(mesh).volume == pytest.approx(2 * whole(right).volume + 1e-6)
    assert report.pieces == 3
    assert report.area_dropped == 0


def test_bodies_that_share_only_an_edge_are_judged_separately():
    outward, inward = box((0.02,) * 3, (0.01, 0.01, 0)), turned(box((0.02,) * 3, (-0.01, -0.01, 0)))
    mesh, _, _ = clean_mesh(joined(outward, inward))
    assert whole(mesh).volume == pytest.approx(2 * 0.02**3)


def test_a_cavity_and_a_solid_within_it_keep_their_orientation():
    shell, core = plain(trimesh.creation.icosphere(2, 0.03)), plain(trimesh.creation.icosphere(2, 0.01))
    cavity = plain(trimesh.creation.icosphere(2, 0.02))
    expected = whole(shell).volume - whole(cavity).volume + whole(core).volume
    hollow = joined(core, shell, turned(cavity))
    for given in (hollow, turned(hollow)):
        assert whole(clean_mesh(given)[0]).volume == pytest.approx(expected)


@pytest.mark.parametrize("inverted", [False, True])
def test_the_inner_side_of_an_open_wall_still_looks_inward(inverted):
    def tube(radius):
        return without(without(plain(trimesh.creation.cylinder(radius, 0.08)), (0, 0, 1)), (0, 0, -1))

    inner = turned(tube(0.036))
    mesh, _, _ = clean_mesh(turned(joined(tube(0.04), inner)) if inverted else joined(tube(0.04), inner))
    cast = whole(mesh)
    radial = np.sum(cast.face_normals[:, :2] * cast.triangles_center[:, :2], 1)
    np.testing.assert_array_equal(radial > 0, np.linalg.norm(cast.triangles_center[:, :2], axis=1) > 0.038)


def test_a_body_with_a_hole_is_turned_but_a_bowl_scanned_from_above_is_not():
    open_box = without(box(), (0, 0, -1))
    mesh, _, report = clean_mesh(turned(open_box))
    assert report.turned == len(open_box.faces)
    assert whole(mesh).face_normals[:, 2].sum() > 0
    bowl = plain(trimesh.creation.icosphere(3, 0.03).slice_plane([0, 0, 0], [0, 0, -1]))
    mesh, _, report = clean_mesh(turned(bowl))
    assert report.turned == 0


def test_a_repeated_wall_is_kept_if_it_is_part_of_the_surface():
    thing = box()
    side = np.arange(len(thing.faces)) < 4
    mesh, _, report = clean_mesh(Mesh(thing.vertices, np.concatenate([thing.faces, thing.faces[side][:, ::-1]])))
    assert whole(mesh).is_watertight
    assert (report.faces, report.repeated) == (12, 4)
    twice = joined(thing, thing)
    assert whole(clean_mesh(twice)[0]).volume == pytest.approx(whole(thing).volume)


def test_a_lid_shared_by_two_bodies_on_the_same_side_is_kept():
    outer, inner = box((0.06, 0.06, 0.04), (0, 0, -0.02)), box((0.04, 0.04, 0.02), (0, 0, -0.01))
    rim = without(inner, (0, 0, 1))  # of the inner body, whose top is cut into the outer one's
    ring = [[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]]
    corners = np.array([[*xy, 0] for xy in ring] + [[2 * x / 3, 2 * y / 3, 0] for x, y in ring])
    frame = [[i, j, 4 + j] for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))]
    frame += [[i, 4 + j, 4 + i] for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))]
    lid = Mesh(corners, np.array([[4, 5, 6], [4, 6, 7]], np.int32))
    for second in (lid, turned(lid)):
        given = joined(without(outer, (0, 0, 1)), Mesh(corners, np.array(frame, np.int32)), lid, rim, second)
        mesh, _, report = clean_mesh(given)
        cast = whole(mesh)
        top = np.isclose(cast.triangles_center[:, 2], 0, atol=1e-9)
        assert cast.area_faces[top].sum() == pytest.approx(0.06**2)
        assert (cast.face_normals[top, 2] > 0).all()
        assert report.repeated == 2


def test_a_two_sided_flag_on_a_pole_is_kept():
    pole = box((0.02, 0.02, 0.06))
    corner = pole.vertices.max(0)
    edge = [int(np.argmin(np.linalg.norm(pole.vertices - corner * s, axis=1))) for s in ([1, 1, 1], [1, 1, -1])]
    tip = len(pole.vertices)
    flag = np.array([[edge[0], edge[1], tip], [edge[1], edge[0], tip]], np.int32)
    vertices = np.concatenate([pole.vertices, corner[None] + [0.03, 0, 0]])
    mesh, _, report = clean_mesh(Mesh(vertices, np.concatenate([pole.faces, flag])))
    assert (len(mesh.faces), report.repeated) == (13, 1)


@pytest.mark.parametrize("small", [2e-3, 5e-4])
def test_an_assembly_keeps_all_of_its_parts_however_small(small):
    rng = np.random.default_rng(0)
    housing = box((0.04, 0.04, 0.04))
    screws = [box((small,) * 3, [*rng.uniform(-0.02, 0.02, 2), 0.021 + 0.001 * i]) for i in range(60)]
    given = joined(housing, *(turned(screw) if i % 2 else screw for i, screw in enumerate(screws)))
    mesh, obstacles, report = clean_mesh(given)
    assert whole(mesh).volume == pytest.approx(0.04**3 + 60 * small**3)
    assert (report.pieces, len(obstacles.faces)) == (61, 0)
