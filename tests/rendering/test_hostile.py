"""What nobody should give the renderer: a sentence, or the value that its documentation promises; and how often it
compiles.
"""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.objects.catalogue import make_object
from i2t.patches.dimensions import REACH
from i2t.rendering.render import prepare_surface, render_heights, render_patch, stack_surfaces
from i2t.types import Surface

PYRAMID = prepare_surface(make_object("pyramid").mesh)  # its flat top, 15 mm wide, is 35 mm high
LOOK = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)  # straight down
LOOK[2, 3] = 0.04
CORNERS, FACE = np.eye(3), np.array([[0, 1, 2]])


def put(*place, value) -> np.ndarray:
    T = LOOK.copy()
    T[place] = value
    return T


@pytest.mark.full
def test_non_finite_poses_affect_their_own_rows_only():
    """Scaled, singular, mirrored, sheared, transposed and non-finite poses give no image; distant ones see nothing."""
    bad = [LOOK @ np.diag(scale).astype(np.float32) for scale in ([2, 2, 2, 1], [1, 1, 0, 1], [1, 1, -1, 1])]
    bad += [0 * LOOK, LOOK.T, LOOK @ (np.eye(4) + 0.01 * np.eye(4, k=1)).astype(np.float32), np.nan * LOOK]
    bad += [put(0, 3, value=np.nan), put(2, 3, value=-np.inf), put(1, 1, value=np.nan), put(3, 3, value=2)]
    far = [put(0, 3, value=huge) for huge in (1e3, 1e20, 1e38)]
    depth, nearest = jax.device_get(jax.jit(jax.vmap(render_patch, (None, 0)))(PYRAMID, np.stack([LOOK, *far, *bad])))
    assert nearest[0] == pytest.approx(5e-3, abs=1e-7)
    assert depth[0].min() == 0
    assert depth[0].max() < REACH
    assert (nearest[1:4] == np.inf).all()
    assert (depth[1:4] == np.float32(REACH)).all()
    assert np.isnan(nearest[4:]).all()
    assert np.isnan(depth[4:]).all()


@pytest.mark.full
def test_singular_maps_flatten_the_surface():
    """`render_heights` accepts any affine map: squashed along z, the pyramid is its shadow; along x, it is seen edge
    on.
    """
    heights = jax.jit(render_heights)
    np.testing.assert_array_equal(np.abs(heights(PYRAMID, np.diag([1, 1, 0, 1]).astype(np.float32))), 0)
    for nothing in (np.diag([0, 1, 1, 1]), np.zeros((4, 4))):
        assert np.isinf(heights(PYRAMID, nothing.astype(np.float32))).all()
    assert np.isnan(heights(PYRAMID, np.full((4, 4), np.nan, np.float32))).all()


@pytest.mark.full
def test_a_nan_corner_removes_its_face():
    """`prepare_surface` refuses such meshes; where a surface is moved afterwards, by an optimiser that diverged, its
    broken faces are never met and its whole ones stay as they were.
    """
    corners = np.asarray(PYRAMID.triangles)
    broken = (corners[:, :, 2].min(1) >= 0.035)[:, None, None]  # the top
    rendered = [np.where(broken, corners[:, :1], corners)]  # shrunk to a point
    for k, bad in ((0, np.nan), (1, np.nan), (2, np.inf)):
        rendered.append(np.where(broken & (np.arange(3) == k)[:, None], bad, corners).astype(np.float32))
    rendered.append(np.full_like(corners, np.nan))
    see = jax.jit(jax.vmap(lambda corners: render_patch(PYRAMID._replace(triangles=corners), jnp.asarray(LOOK))))
    depth, nearest = jax.device_get(see(np.stack(rendered)))
    assert nearest[0] > 5.1e-3
    for i in (1, 2, 3):
        np.testing.assert_array_equal(depth[i], depth[0])
        np.testing.assert_array_equal(nearest[i], nearest[0])
    assert nearest[4] == np.inf


def mesh(vertices=CORNERS, faces=FACE) -> SimpleNamespace:
    return SimpleNamespace(vertices=vertices, faces=np.asarray(faces))


@pytest.mark.parametrize(
    ("thing", "message"),
    [
        (CORNERS, "a ndarray has no vertices and faces"),
        (mesh(np.zeros((0, 3)), np.zeros((0, 3), int)), "no faces"),
        (mesh(faces=[[0.0, 1, 2]]), "integers"),
        (mesh(faces=[[True, False, True]]), "integers"),
        (mesh(faces=[[0, 1, 3]]), "0 to 2"),
        (mesh(faces=[[-1, 1, 2]]), "0 to 2"),
        (mesh(np.zeros((4, 3)), [[0, 1, 2, 3]]), "triangulate"),
        (mesh(np.zeros((4, 2))), "triangulate"),
        (mesh(CORNERS * 1j), "reals"),
        (mesh([["a", "b", "c"]] * 3), "reals"),
        (mesh(CORNERS * np.nan), "NaN"),
        (mesh(CORNERS * 3e38), r"lies 3e\+38 m out"),
        (mesh(CORNERS * 101), "lies 101 m out"),
    ],
)
def test_hostile_meshes_get_a_sentence(thing, message):
    with pytest.raises(ValueError, match=message):
        prepare_surface(thing)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"window": 0.0}, "window: is 0"),
        ({"window": np.nan}, "window: is nan"),
        ({"pixels": 0}, "pixels: is 0"),
        ({"pixels": 2.5}, "pixels: is 2.5"),
        ({"reach": -1.0}, "reach: is -1.0"),
        ({"T_o_t": LOOK[:3]}, r"shape \(3, 4\) instead of \(4, 4\)"),
        ({"T_o_t": np.stack([LOOK, LOOK])}, "use vmap for several"),
        ({"surface": stack_surfaces([PYRAMID, PYRAMID])}, "use vmap for a stack"),
        ({"surface": Surface(PYRAMID.triangles)}, "prepare"),
        (
            {"surface": Surface(*(np.zeros(s, np.float32) for s in ((0, 3, 3), (0, 6, 32), (6, 0))))},
            "not those of one",
        ),
    ],
)
def test_invalid_sizes_and_shapes_are_refused(given, message):
    for render in (render_patch, *([render_heights] if given.keys() <= {"window", "pixels", "surface"} else [])):
        unchecked = getattr(render, "__wrapped__", render)  # without the tests' own check of shapes
        place = {"T_o_t" if render is render_patch else "A_t_w": jnp.asarray(LOOK)}
        with pytest.raises((ValueError, TypeError), match=message) as caught:
            unchecked(**{"surface": PYRAMID, **place, **given})
        assert "\n" not in str(caught.value)


def test_one_compilation_for_all_meshes_of_a_size_class_and_a_stack_is_of_its_largest():
    rng, traced = np.random.default_rng(0), []

    def soup(faces: int) -> Surface:
        return prepare_surface(mesh(rng.uniform(-0.03, 0.03, (3 * faces, 3)), np.arange(3 * faces).reshape(-1, 3)))

    @jax.jit
    def look(surface, T):
        traced.append(surface.triangles.shape[0])
        return render_patch(surface, T)

    for faces in (1, 12, 63, 64, 65, 128, 200, 20_000):
        jax.eval_shape(look, soup(faces), LOOK)
    assert traced == [64, 128, 256, traced[-1]]
    with pytest.raises(ValueError, match="no surfaces"):
        stack_surfaces([])
    small, large = soup(1), soup(200)
    for pair in ([small, large], [large, small], [large, large]):
        assert stack_surfaces(pair).triangles.shape == (2, *large.triangles.shape)
