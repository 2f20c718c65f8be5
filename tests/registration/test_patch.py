"""Poses from patches: closed forms on planes, a known pose found again, what is unobservable left alone, and the
experiment.
"""

import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from experiments.registration.arguments import PatchPoseArgs
from experiments.registration.patch import run
from i2t.geometry import log
from i2t.registration.patch import (
    PatchRegistrationConfig,
    pose_information,
    refine_pose,
    resolvable_eigenvalue,
)
from i2t.rendering.render import prepare_surface, render_patch
from i2t.types import Patch
from i2t.windows import PATCH_PIXELS, PATCH_WINDOW, REACH, TWIST_LEVER_M

HOW = PatchRegistrationConfig()
look = jax.jit(render_patch)
refine_all = jax.jit(jax.vmap(refine_pose, (None, 0, 0)))


def sheet(height, n: int = 24, half: float = 0.03) -> SimpleNamespace:
    """The graph z = height(x, y) over a square."""
    along = np.linspace(-half, half, n + 1)
    x, y = np.meshgrid(along, along)
    corner = np.arange(n * (n + 1)).reshape(n, n + 1)[:, :n].ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + n + 2], 1), np.stack([corner, corner + n + 2, corner + n + 1], 1)]
    )
    return SimpleNamespace(vertices=np.stack([x, y, height(x, y)], -1).reshape(-1, 3), faces=faces)


WAVES = prepare_surface(
    sheet(lambda x, y: 1.5e-3 * np.sin(x / 3e-3 + 1) * np.cos(y / 4e-3) + 1e-3 * np.sin(y / 5e-3), n=44)
)
PLANE = prepare_surface(sheet(lambda x, y: 0 * x, n=44))  # of the same size class


def off(seed: int, distance: float = 2e-3, degrees: float = 4.0, count: int = 4) -> np.ndarray:
    """Rigid motions of this length and angle in random directions."""
    along, axis = np.random.default_rng(seed).normal(size=(2, count, 3))
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 3] = distance * along / np.linalg.norm(along, axis=1, keepdims=True)
    turn = np.radians(degrees) * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    T[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix()
    return T.astype(np.float32)


def repeated(patch: Patch, count: int = 4) -> Patch:
    return jax.tree.map(lambda a: jnp.repeat(a[None], count, axis=0), patch)


def twist_between(T_a: np.ndarray, T_b: np.ndarray) -> np.ndarray:
    return log(np.linalg.inv(np.asarray(T_a, float)) @ np.asarray(T_b, float)) * ([1.0] * 3 + [TWIST_LEVER_M] * 3)


@pytest.mark.full
def test_gauss_newton_matrix_of_planes():
    """Moving the tool by t and turning it by w changes the height z over the pixel (x, y) of a plane with normal
    (-a, -b, 1) by -(normal . (t + w x p)) for the point p there.
    """
    pixel = ((np.arange(PATCH_PIXELS) + 0.5) / PATCH_PIXELS - 0.5) * PATCH_WINDOW
    x, y = (v.ravel() for v in np.meshgrid(pixel, pixel))
    a, b = 0.12, -0.08
    T = np.eye(4)
    T[:3, 2] = np.array([-a, -b, 1]) / np.sqrt(1 + a * a + b * b)  # the plane's normal, in the tool's axes
    T[:3, 0] = np.cross([0, 1, 0], T[:3, 2]) / np.linalg.norm(np.cross([0, 1, 0], T[:3, 2]))
    T[:3, 1] = np.cross(T[:3, 2], T[:3, 0])
    normal = T[2, :3] / T[2, 2]
    p = np.stack([x, y, -(normal[0] * x + normal[1] * y)], -1)
    normals = np.broadcast_to(normal, p.shape)
    slopes = np.concatenate([-normals, -np.cross(p, normals) / TWIST_LEVER_M], 1)
    expected = np.linalg.eigvalsh(slopes.T @ slopes / len(p))
    values, directions = jax.jit(pose_information)(PLANE, T.astype(np.float32))
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-5)  # a few dozen roundings of numbers up to 1
    np.testing.assert_allclose(directions.T @ directions, np.eye(6), atol=1e-5)
    assert (values >= 1e-3).sum() == 3
    # At eigenvalue 1 (along the tool axis of a plane) the estimate is a mean of all pixels.
    assert resolvable_eigenvalue(noise=1.0, error=2 / 48, pixels=48) == pytest.approx(1)
    np.testing.assert_allclose(sorted(expected)[:3], 0, atol=1e-12)


@pytest.mark.full
def test_pose_is_found_again_on_waves():
    """All six directions can be told, and come back to where float32 still tells heights apart: NEAR = 1e-7 m over the
    root of the smallest eigenvalue.
    """
    true = np.eye(4, dtype=np.float32)
    ends = refine_all(WAVES, repeated(look(WAVES, true)), off(0, 1e-3, 2.0))
    least = np.asarray(ends.eigenvalues).min()
    assert least > 1e-3
    assert np.abs(twist_between(true, ends.T_o_t)).max() <= 1e-7 / least**0.5
    assert (np.asarray(ends.steps) < HOW.max_steps).all()


@pytest.mark.full
def test_outliers_do_not_pull():
    """A twentieth of the pixels is off by more than a millimetre: flying pixels of a camera."""
    true = np.eye(4, dtype=np.float32)
    patch = look(WAVES, true)
    rng = np.random.default_rng(3)
    wild = rng.random(patch.depth.shape) < 0.05
    depth = np.where(wild, rng.uniform(0, REACH, patch.depth.shape), patch.depth).astype(np.float32)
    ends = refine_all(WAVES, repeated(Patch(jnp.asarray(depth), patch.nearest)), off(1, 0.5e-3, 1.0))
    # A residual of a millimetre and more weighs at most (1 + (1 mm / fine)^2)^-2 = 1e-4, so the pull of 5 % of them
    # with 1.5 mm moves the heights by 0.05 * 1e-4 * 1.5 mm = 8 nm, the few below a millimetre by up to 0.3 fine * 1 %.
    least = np.asarray(ends.eigenvalues).min()
    assert np.abs(twist_between(true, ends.T_o_t)).max() <= 0.003 * HOW.final_scale / least**0.5


@pytest.mark.full
def test_what_cannot_be_told_is_left_alone():
    """On a plane height and tilts come back; slides and spin keep what they were, for nothing pushes them."""
    start = off(2)
    ends = refine_all(PLANE, repeated(look(PLANE, np.eye(4, dtype=np.float32))), start)
    np.testing.assert_allclose(np.asarray(ends.T_o_t)[:, 2], [[0, 0, 1, 0]] * 4, rtol=0, atol=2e-6)
    left, before = twist_between(np.eye(4), ends.T_o_t), twist_between(np.eye(4), start)
    # Turned tilts slide by their angle times the height that they correct: 4 degrees of 2 mm.
    np.testing.assert_allclose(left[:, :2], before[:, :2], rtol=0, atol=2 * np.radians(4) * 2e-3)
    np.testing.assert_allclose(left[:, 5], before[:, 5], rtol=0, atol=np.radians(4) ** 2 * TWIST_LEVER_M)


@pytest.mark.full
def test_nothing_to_see_and_nowhere_to_start():
    empty = Patch(jnp.full((PATCH_PIXELS, PATCH_PIXELS), REACH), jnp.asarray(jnp.inf))
    full = look(WAVES, np.eye(4, dtype=np.float32))
    observed = jax.tree.map(lambda *leaves: jnp.stack(leaves), empty, full, full, empty)
    start = off(4, 1e-4, 0.1)
    start[1, 0, 3] = np.nan
    ends = refine_all(WAVES, observed, start)
    assert np.isnan(ends.T_o_t[1]).any()
    assert np.isfinite(ends.T_o_t[2]).all()
    assert (np.abs(twist_between(np.eye(4), ends.T_o_t[2:3])) < 1e-5).all()
    np.testing.assert_array_equal(ends.T_o_t[0], start[0])
    np.testing.assert_array_equal(ends.T_o_t[3], start[3])


@pytest.mark.full
def test_the_experiment_in_small(tmp_path, capsys):
    args = PatchPoseArgs(out=tmp_path / "run", preset="debug")
    report = run(args)
    assert json.loads((tmp_path / "run" / "metrics.json").read_text()) == report
    assert report["source"] == "simulated"
    assert report["at_start"]["success"] == 0
    low, high = report["methods"]["one start, no noise"]["success_interval"]
    assert low <= report["methods"]["one start, no noise"]["success"] <= high
    assert "simulated cases on 3 objects" in capsys.readouterr().out
    with pytest.raises(ValueError, match="holds a finished run"):
        run(args)
