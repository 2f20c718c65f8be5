"""What nobody should give the renderer: a sentence, or the value that its documentation promises; and how often it
compiles.
"""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from i2t.objects.catalogue import make_object
from i2t.rendering.render import prepare_surface, render_heights, render_patch, stack_surfaces
from i2t.types import REACH, STANDOFF

TOP = 0.035  # m, height of the flat top of the pyramid, 15 mm wide
HUGE = (1e3, 1e20, 1e38)  # m


def looking_down(x: float = 0.0, z: float = TOP + 5e-3) -> np.ndarray:
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[0, 3], T[2, 3] = x, z
    return T.astype(np.float32)


def soup(*triangles) -> SimpleNamespace:
    return SimpleNamespace(vertices=np.reshape(triangles, (-1, 3)), faces=np.arange(3 * len(triangles)).reshape(-1, 3))


@pytest.fixture(scope="module")
def pyramid():
    return prepare_surface(make_object("pyramid").mesh)


@pytest.fixture(scope="module")
def patches_of():
    """One compilation for a batch of 8 poses or surfaces."""
    return jax.jit(jax.vmap(render_patch))


def batch(surfaces, poses):
    """Eight of each, the last repeated."""
    poses = list(poses) + [poses[-1]] * (8 - len(poses))
    surfaces = list(surfaces) + [surfaces[-1]] * (8 - len(surfaces))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *surfaces), np.stack(poses)


@pytest.mark.full
def test_bad_poses_spoil_their_own_rows_only(pyramid, patches_of):
    """Numbers that are not finite give an image that is not a number; places far away see nothing."""
    poses = [looking_down() for _ in range(8)]
    poses[1][0, 3] = np.nan
    poses[2][2, 3] = -np.inf
    poses[3][1, 1] = np.nan
    poses[4][:] = np.nan
    for i, far in enumerate(HUGE):
        poses[5 + i][0, 3] = far
    depth, nearest = jax.device_get(patches_of(*batch([pyramid], poses)))
    assert nearest[0] == pytest.approx(5e-3, abs=1e-7)
    assert depth[0].min() == 0
    assert depth[0].max() < REACH
    assert np.isnan(depth[1:5]).all()
    assert (nearest[5:] == np.inf).all()
    assert (depth[5:] == np.float32(REACH)).all()


@pytest.mark.full
def test_singular_maps_flatten_the_surface(pyramid):
    """`render_heights` takes any affine map: squashed along z the pyramid is its shadow, along x it is edge on."""
    heights = jax.jit(render_heights)
    above = np.abs(np.asarray(heights(pyramid, np.diag([1, 1, 0, 1]).astype(np.float32))))
    np.testing.assert_array_equal(above, 0)
    for nothing in (np.diag([0, 1, 1, 1]), np.zeros((4, 4))):
        assert np.isinf(heights(pyramid, nothing.astype(np.float32))).all()
    assert np.isnan(heights(pyramid, np.full((4, 4), np.nan, np.float32))).all()


@pytest.mark.full
def test_what_lies_behind_the_rays_is_not_met(pyramid, patches_of):
    """Under the table, or with the pyramid more than the standoff behind: nothing."""
    poses = [looking_down(z=-1e-3), looking_down(z=-STANDOFF - 1e-3)]
    _, nearest = jax.device_get(patches_of(*batch([pyramid], poses)))
    assert nearest[0] == pytest.approx(-TOP - 1e-3, abs=1e-7)
    assert nearest[1] == np.inf


@pytest.mark.full
def test_compiled_once_for_all_meshes_of_a_class():
    """A batch of poses on each of many meshes: as many compilations as size classes, however the meshes differ."""
    rng = np.random.default_rng(0)

    def mesh(faces):
        return prepare_surface(soup(*rng.uniform(-0.03, 0.03, (faces, 3, 3))))

    render = jax.jit(jax.vmap(render_patch, (None, 0)))
    poses = np.stack([looking_down()] * 4)
    for faces in (1, 12, 40, 63, 64):
        render(mesh(faces), poses)
    assert render._cache_size() == 1

    traced = []

    @jax.jit
    def look(surface, poses):
        traced.append(surface.triangles.shape[0])
        return jax.vmap(render_patch, (None, 0))(surface, poses)

    sizes = np.unique(np.geomspace(1, 20_000, 30).astype(int))
    for faces in sizes:
        jax.eval_shape(look, mesh(faces), poses)
    classes = 1 + int(np.ceil(np.log2(sizes[-1] / 64)))  # 64 faces, and each doubling after
    assert len(traced) == len(set(traced)) <= classes


def test_a_stack_is_compiled_for_its_largest_class_alone():
    small, large = prepare_surface(soup([[0, 0, 0], [1, 0, 0], [0, 1, 0]])), prepare_surface(make_object("hammer").mesh)
    shapes = [stack_surfaces(pair).triangles.shape for pair in ([small, large], [large, small], [large, large])]
    assert len(set(shapes)) == 1
    assert shapes[0][1:] == large.triangles.shape
