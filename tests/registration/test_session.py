"""Placement and hand-eye of a session from its own touches: views made by Embree, coverage over simulated sessions, and
what cannot be registered.
"""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rendering.test_render import embree_heights
from scipy import stats
from scipy.spatial.transform import Rotation

import i2t
from i2t.collect.arguments import LabArgs
from i2t.collect.registration_check import describe_offsets
from i2t.collect.start import read_rig
from i2t.contact.approach import first_contact
from i2t.dataset import Dataset
from i2t.geometry import from_twist, inverse, to_twist
from i2t.patches.dimensions import PATCH_WINDOW, REACH, VIEW_PIXELS, VIEW_WINDOW
from i2t.patches.views import view_of_noisy_heights
from i2t.recognition.site_pool import prepare_surfaces
from i2t.registration import SessionEstimate, SessionRegistrationConfig, register_session
from i2t.registration import session as sessions
from i2t.registration.sets import depth_noise, register_sessions, with_registered_views
from i2t.rendering.render import render_heights, render_view
from i2t.simulation import sites as touch_sites
from i2t.simulation.touches import SimulationErrors, sample_session_errors
from i2t.types import ReturnCode, Touches

NAMES = ("hexagon", "hammer")
MESHES = [i2t.make_object(name).mesh for name in NAMES]
SURFACES = dict(zip(NAMES, prepare_surfaces(MESHES), strict=True))
PRESS, NOISE = 1e-3, 0.1e-3  # m past first contact; m, of a pixel
APART = np.array([0.9, -1.4, 0.5, 0.06, -0.1, 0.15]) * 1e-3, np.array([-1.2, 0.8, 0.6, -0.05, 0.07, 0.04]) * 1e-3
CONFIG = SessionRegistrationConfig(depth_noise=NOISE, depth_bleed=0.3)


def embree_touches(mesh, surface, T_w_o: np.ndarray, T_t_camera: np.ndarray, n: int = 12) -> Touches:
    """Touches of an object that is believed at the origin, by an arm without error, with views by Embree."""
    sites = touch_sites.sample_sites(jax.random.key(3), surface, n).T_w_t
    believed = inverse(jnp.float32(T_w_o))
    T_o_t, _, hit = jax.vmap(lambda T: first_contact(surface, believed @ T, before=0.02, beyond=0.06))(sites)
    assert np.asarray(hit).all()
    end = np.eye(4)
    end[2, 3] = PRESS
    T_w_t = T_w_o @ np.asarray(T_o_t, float) @ end
    triangles = np.float32(mesh.vertices)[np.asarray(mesh.faces)]
    cameras = np.linalg.inv(T_w_o) @ T_w_t @ T_t_camera
    z = embree_heights(triangles, np.float32(cameras), VIEW_WINDOW, VIEW_PIXELS)
    view = jax.vmap(view_of_noisy_heights)(jnp.float32(z + NOISE * np.random.default_rng(0).normal(size=z.shape)))
    none = np.zeros(n, np.int32)
    still = np.tile(np.eye(4, dtype=np.float32), (n, 1, 1))
    seen = (np.asarray(part) for part in (view.patch.depth, view.depth, view.patch.nearest))
    force, depth, code = np.ones(n), np.full(n, PRESS), np.full(n, ReturnCode.SKIN)
    return Touches(*seen, np.zeros((n, 15)), force, depth, np.float32(T_w_t), still, none, none, none, code)


def twist_between(true: np.ndarray, estimated: np.ndarray) -> np.ndarray:
    return to_twist(np.linalg.inv(np.asarray(estimated, float)) @ np.asarray(true, float))


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_object_and_camera_are_located_by_embree_views_and_contacts(name):
    """Both are displaced by a millimetre or more along each axis, and rotated by a degree about some."""
    placed, camera = (np.asarray(from_twist(jnp.float32(twist)), float) for twist in APART)
    touches = embree_touches(MESHES[NAMES.index(name)], SURFACES[name], placed, camera)
    estimate = register_session(touches, SURFACES[name], config=CONFIG)
    error = np.concatenate([twist_between(placed, estimate.T_w_o), twist_between(camera, estimate.T_t_camera)])
    assert np.abs(error / np.sqrt(np.diag(estimate.covariance))).max() < 4
    assert np.abs(error[[0, 1, 6, 7]]).max() < 0.08e-3
    assert np.median(estimate.view_residual) < 1.5
    # The contacts of a wrong mesh and its views agree nowhere.
    other = NAMES[1 - NAMES.index(name)]
    assert np.median(register_session(touches, SURFACES[other], config=CONFIG).view_residual) > 5


@pytest.mark.full
def test_intervals_of_session_twists_cover_the_truth():
    """Eight sessions with all errors of a lab, 96 components of twists; the truth is what the simulator drew."""
    errors, pad = SimulationErrors(), i2t.sample_pad(jax.random.key(0))
    touches = i2t.simulate_touches(jax.random.key(0), list(SURFACES.values()), pad, errors, 4 * 36)
    dataset = Dataset.simulated(touches, NAMES, pad)
    standard = []
    few = SessionRegistrationConfig(num_starts=2)
    for number, estimate in register_sessions(dataset, SURFACES, config=few).items():
        key = jax.random.split(jax.random.fold_in(jax.random.key(0), number), 4)[0]
        true = sample_session_errors(key, errors)
        error = [twist_between(true.T_o_placed, estimate.T_w_o), twist_between(true.T_t_camera, estimate.T_t_camera)]
        standard.append(np.concatenate(error) / np.sqrt(np.diag(estimate.covariance)))
        # Sideways, a millimetre before the session is some hundredths after it.
        assert np.abs(np.concatenate(error)[[0, 1, 6, 7]]).max() < 0.15e-3
    inside = np.abs(standard) < 1.96
    assert inside.shape == (8, 12)
    assert inside.mean() > stats.binom.ppf(0.001, inside.size, 0.95) / inside.size


def test_derivatives_are_those_of_moved_cameras():
    """Derivatives of blurred renderings, including silhouettes, are compared with differences over half a pixel."""
    surface, pixels, pitch = SURFACES["hexagon"], 48, PATCH_WINDOW / 48
    T_o_c = np.asarray(i2t.contact_pose(MESHES[0], np.array([0.016, 0.004, 0.03]), roll=0.4), float)
    T_o_c = T_o_c @ np.asarray(from_twist(jnp.float32([0, 0, -1e-3, 1e-4, -2e-4, 0])), float)
    limit, blurring = jnp.float32(2.5e-3), sessions._blurring(pixels, 3.0, 3.0)
    rendered = jax.jit(lambda T: jnp.minimum(render_heights(surface, inverse(T), PATCH_WINDOW, pixels), limit))

    def blurred(image):
        return blurring @ np.asarray(image) @ blurring.T

    derivatives, _ = sessions._by_camera_twist(rendered(jnp.float32(T_o_c)), limit, pitch)
    assert (np.asarray(rendered(jnp.float32(T_o_c))) >= limit).any()  # its side is in sight
    for axis, derivative in enumerate(derivatives):
        step = np.zeros(6, np.float32)
        step[axis] = pitch
        sides = [blurred(rendered(jnp.float32(T_o_c @ np.asarray(from_twist(sign * step))))) for sign in (1, -1)]
        expected, ours = (sides[0] - sides[1]) / (2 * pitch), blurred(derivative)
        assert np.corrcoef(expected.ravel(), ours.ravel())[0, 1] > 0.99, axis
        # Samples at the border see half a blur only, which an edge leaves in one step.
        inside = np.s_[1:-1, 1:-1]
        np.testing.assert_allclose(ours[inside], expected[inside], atol=0.1 * np.abs(expected).max())


def test_noise_is_measured_and_what_cannot_be_registered_is_refused():
    rng = np.random.default_rng(0)
    x = np.linspace(-1, 1, 48)
    slopes = 1.5e-3 + 0.5e-3 * (rng.normal(size=(40, 1, 1)) * x + rng.normal(size=(40, 1, 1)) * x[:, None])
    noisy = np.clip(slopes + 0.2e-3 * rng.normal(size=(40, 48, 48)), 0, REACH)
    assert depth_noise(noisy) == pytest.approx(0.2e-3, rel=0.03)
    assert depth_noise(slopes) == 20e-6
    still = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    images, numbers = np.zeros((2, 48, 48), np.float32), np.zeros(2, np.float32)
    touches = Touches(
        images, np.zeros((2, 72, 72), np.float32), numbers, np.zeros((2, 15)), numbers, numbers, still, still,
        np.zeros(2, int), np.zeros(2, int), np.arange(2), np.full(2, ReturnCode.AIR),
    )  # fmt: skip
    with pytest.raises(ValueError, match="from 2 sessions"):
        register_session(touches, SURFACES["hammer"])
    with pytest.raises(ValueError, match="none met the object"):
        register_session(touches._replace(session=np.zeros(2, int)), SURFACES["hammer"])


def test_views_of_registered_sessions_are_rendered_at_the_estimated_poses():
    """One of two sessions is registered; the other keeps the camera's views."""
    n = 3
    pose = np.asarray(i2t.contact_pose(MESHES[0], np.array([0.0, 0.0, 0.03])), np.float32)
    T_w_t = np.tile(pose, (2 * n, 1, 1))
    T_w_t[:, 0, 3] += np.float32(np.linspace(-5e-3, 5e-3, 2 * n))
    still, numbers = np.tile(np.eye(4, dtype=np.float32), (2 * n, 1, 1)), np.zeros(2 * n, np.float32)
    touches = Touches(
        np.zeros((2 * n, 48, 48)), np.zeros((2 * n, 72, 72)), numbers, np.zeros((2 * n, 15)), numbers, numbers,
        T_w_t, still, np.zeros(2 * n, int), np.zeros(2 * n, int), np.repeat([0, 1], n), np.full(2 * n, ReturnCode.SKIN),
    )  # fmt: skip
    pad = i2t.nominal_pad()
    dataset = Dataset.simulated(touches, ("hexagon",), pad)
    estimate = SessionEstimate(from_twist(jnp.float32(APART[0])), jnp.eye(4), jnp.eye(12), numbers[:n], numbers[:n])
    after = with_registered_views(dataset, SURFACES, {1: estimate}).touches
    np.testing.assert_array_equal(after.view[:n], 0)
    for row in range(n, 2 * n):
        expected = render_view(SURFACES["hexagon"], inverse(estimate.T_w_o) @ T_w_t[row])
        np.testing.assert_allclose(after.view[row], expected.depth, atol=1e-6)
        np.testing.assert_allclose(after.patch[row], expected.patch.depth, atol=1e-6)
        assert after.nearest[row] == pytest.approx(float(expected.patch.nearest), abs=1e-6)
        np.testing.assert_array_equal(after.T_w_o[row], estimate.T_w_o)


@pytest.mark.full
def test_a_collection_reports_the_errors_of_object_and_camera():
    """The camera is displaced in tool axes at the pose from which it looks, so its rotation also moves its views."""
    rig, hammer = read_rig(LabArgs(), real=False), MESHES[1]
    placed, camera = (np.asarray(from_twist(jnp.float32(twist)), float) for twist in APART)
    back = np.eye(4)
    back[:3, 3] = -(rig.looking_distance * rig.T_tool_camera[:3, 2] + rig.T_tool_camera[:3, 3])
    touches = embree_touches(hammer, SURFACES["hammer"], placed, back @ camera @ np.linalg.inv(back))
    dataset = Dataset.simulated(touches, ("hammer",), i2t.nominal_pad())
    report = describe_offsets(dataset, hammer, 0, rig)
    numbers = [float(part) for pair in re.findall(r"([\d.]+) mm and ([\d.]+) degrees \(", report) for part in pair]
    expected = [
        value
        for motion in (placed, camera)
        for value in (1e3 * np.linalg.norm(motion[:3, 3]), np.degrees(Rotation.from_matrix(motion[:3, :3]).magnitude()))
    ]
    np.testing.assert_allclose(numbers, expected, atol=0.2)
    assert report.endswith("; the simulation displaces both on purpose (--no-pose-error)")
    real = describe_offsets(replace(dataset, source="real"), hammer, 0, rig)
    assert real.endswith("; calibrate the rig again (docs/hardware.md)")
    assert "11 touches" in describe_offsets(dataset.select(slice(11)), hammer, 0, rig)
