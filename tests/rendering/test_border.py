"""What is refused at the renderer's border in a sentence, and poses that are not rigid."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.objects.catalogue import make_object
from i2t.rendering.render import prepare_surface, render_heights, render_patch, stack_surfaces
from i2t.types import REACH, Surface

PYRAMID = prepare_surface(make_object("pyramid").mesh)
DOWN = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)
unchecked = getattr(render_patch, "__wrapped__", render_patch)  # without the tests' own check of shapes


@pytest.mark.full
def test_poses_that_are_not_rigid_give_no_image():
    """Scaled, singular, mirrored, sheared and transposed ones, and those with a number that is none, in one batch."""
    good = DOWN.copy()
    good[:3, 3] = 0, 0, 0.04
    bad = [good @ np.diag(scale).astype(np.float32) for scale in ([2, 2, 2, 1], [1, 1, 0, 1], [1, 1, -1, 1])]
    bad += [0 * good, good.T, good @ (np.eye(4) + 0.01 * np.eye(4, k=1)).astype(np.float32)]
    for place, value in (((0, 3), np.nan), ((2, 3), np.inf), ((1, 1), np.nan), ((3, 3), 2)):
        bad.append(good.copy())
        bad[-1][place] = value
    depth, nearest = jax.device_get(jax.jit(jax.vmap(render_patch, (None, 0)))(PYRAMID, np.stack([good, *bad])))
    assert nearest[0] == pytest.approx(5e-3, abs=1e-7)
    assert depth[0].max() < REACH
    assert np.isnan(nearest[1:]).all()
    assert np.isnan(depth[1:]).all()


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"window": 0.0}, "window: is 0"),
        ({"window": -0.01}, "window: is -0.01"),
        ({"window": np.nan}, "window: is nan"),
        ({"window": np.inf}, "window: is inf"),
        ({"pixels": 0}, "pixels: is 0"),
        ({"pixels": -3}, "pixels: is -3"),
        ({"pixels": 2.5}, "pixels: is 2.5"),
        ({"reach": 0.0}, "reach: is 0.0"),
        ({"reach": -1.0}, "reach: is -1.0"),
        ({"reach": np.nan}, "reach: is nan"),
        ({"T_w_t": DOWN[:3]}, r"shape \(3, 4\) instead of \(4, 4\)"),
        ({"T_w_t": DOWN[:3, :3]}, r"shape \(3, 3\)"),
        ({"T_w_t": np.stack([DOWN, DOWN])}, "use vmap for several"),
        ({"surface": stack_surfaces([PYRAMID, PYRAMID])}, "use vmap for a stack"),
        (
            {"surface": Surface(*(np.zeros(s, np.float32) for s in ((0, 3, 3), (0, 6, 32), (6, 0))))},
            "not those of one",
        ),
    ],
)
def test_sizes_and_shapes_that_mean_nothing_get_a_sentence(given, says):
    with pytest.raises((ValueError, TypeError), match=says) as caught:
        unchecked(**{"surface": PYRAMID, "T_w_t": jnp.asarray(DOWN), **given})
    assert "\n" not in str(caught.value)


def test_heights_too():
    bare = getattr(render_heights, "__wrapped__", render_heights)
    with pytest.raises(ValueError, match=r"window: is 0"):
        bare(PYRAMID, jnp.eye(4), 0.0)
    with pytest.raises(ValueError, match="prepare"):
        bare(Surface(PYRAMID.triangles), jnp.eye(4))


CORNERS = np.eye(3)


@pytest.mark.parametrize(
    ("mesh", "says"),
    [
        (np.eye(3), "a ndarray has no vertices and faces"),
        (SimpleNamespace(vertices=CORNERS, faces=np.array([[0.0, 1, 2]])), "integers"),
        (SimpleNamespace(vertices=CORNERS, faces=np.array([[True, False, True]])), "integers"),
        (SimpleNamespace(vertices=CORNERS * 1j, faces=np.array([[0, 1, 2]])), "reals"),
        (SimpleNamespace(vertices=[["a", "b", "c"]] * 3, faces=np.array([[0, 1, 2]])), "reals"),
        (SimpleNamespace(vertices=CORNERS * 3e38, faces=np.array([[0, 1, 2]])), r"lies 3e\+38 m out"),
        (SimpleNamespace(vertices=CORNERS * 101, faces=np.array([[0, 1, 2]])), "lies 101 m out"),
    ],
)
def test_hostile_meshes_get_a_sentence(mesh, says):
    with pytest.raises(ValueError, match=says):
        prepare_surface(mesh)


def test_nothing_to_stack():
    with pytest.raises(ValueError, match="no surfaces"):
        stack_surfaces([])


@pytest.mark.full
def test_a_corner_that_is_not_a_number_takes_its_face_away():
    """`prepare` refuses such meshes; where a surface is moved afterwards, by an optimiser that diverged, its broken
    faces are never met and its whole ones stay as they were.
    """
    corners = np.asarray(PYRAMID.triangles)
    T = DOWN.copy()
    T[2, 3] = 0.04
    rendered = []
    for broken in (corners[:, :, 2].min(1) >= 0.035, np.ones(len(corners), bool)):
        gone = np.where(broken[:, None, None], corners[:, :1], corners)  # shrunk to a point
        rendered.append(gone)
        rendered += [
            np.where((np.arange(3) == k)[:, None] & broken[:, None, None], bad, corners).astype(np.float32)
            for k, bad in ((0, np.nan), (1, np.nan), (2, np.inf))
        ]
    see = jax.jit(jax.vmap(lambda corners: render_patch(PYRAMID._replace(triangles=corners), jnp.asarray(T))))
    depth, nearest = jax.device_get(see(np.stack(rendered)))
    for first in (0, 4):
        for broken in range(first + 1, first + 4):
            np.testing.assert_array_equal(depth[broken], depth[first])
            np.testing.assert_array_equal(nearest[broken], nearest[first])
    assert nearest[1] > 5.1e-3  # the top is gone
    assert nearest[5] == np.inf  # and here everything
