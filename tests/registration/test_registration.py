"""Poses from touches: a closed form on a plane, calibration over runs, what is symmetric, air and outliers. Poses from
depth images: made by Embree with a millimetre of noise, on a table, and of real cameras.
"""

import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from depth.test_patches import image
from helpers.compilations import compilations
from scipy import stats
from scipy.spatial.transform import Rotation

from experiments.registration.frames import OBJECTS, frames
from i2t.contact.approach import double_areas, first_contact
from i2t.depth.camera import Camera
from i2t.geometry import inverse, random_motion, to_twist
from i2t.objects import make_object, read_mesh
from i2t.patches.dimensions import PAD_WINDOW, TWIST_LEVER_M
from i2t.registration import camera_covariance, contact_poses, contacts, register_by_depth, register_by_touch, touch
from i2t.registration.contacts import STUDENT_T_DOF
from i2t.rendering.render import prepare_surface, stack_surfaces
from i2t.simulation import sites as touch_sites
from i2t.types import ReturnCode, Surface, Touches

NAMES = ("hexagon", "cylinder", "spanner")
STACK = stack_surfaces([prepare_surface(make_object(name).mesh) for name in NAMES])  # one size class, one compilation
SURFACES = [jax.tree.map(lambda field, i=i: jnp.asarray(field[i]), STACK) for i in range(len(NAMES))]
DISTANCE, ANGLE, NOISE = 1e-3, math.radians(1.0), 0.1e-3
SPREAD = np.array([DISTANCE] * 3 + [ANGLE * TWIST_LEVER_M] * 3)
TOUCHES, RUNS = 10, 12
prior = {"translation_std": DISTANCE, "rotation_std": ANGLE, "contact_std": NOISE}
register = jax.jit(partial(register_by_touch, **prior))


def probe(key, surface: Surface):
    """The true pose of an object, and the poses of first contact on ten sites of its believed pose (the origin), each
    with noise of NOISE along each axis.
    """
    key_sites, key_motion, key_noise = jax.random.split(key, 3)
    sites = touch_sites.sample_sites(key_sites, surface, TOUCHES)
    T_w_o = random_motion(key_motion, DISTANCE, ANGLE)

    def press(key, T_w_site):
        T_o_t, _, hit = first_contact(surface, inverse(T_w_o) @ T_w_site, before=0.02, beyond=0.06)
        return T_w_o @ T_o_t @ random_motion(key, NOISE, 0.0), hit

    contacts, hit = jax.vmap(press)(jax.random.split(key_noise, TOUCHES), sites.T_w_t)
    return T_w_o, contacts, hit & sites.safe


@jax.jit
def draw(keys, surface: Surface):
    return jax.lax.map(lambda key: probe(key, surface), keys)


def runs(surface: Surface, seed: int, count: int = RUNS):
    """Draw true poses and register them."""
    true, contacts, hit = draw(jax.random.split(jax.random.key(seed), RUNS), surface)
    keys = jax.random.split(jax.random.key(seed + 100), RUNS)
    estimates = [register(keys[i], surface, jnp.eye(4), contacts[i], hit[i]) for i in range(count)]
    return np.asarray(true)[:count], jax.tree.map(lambda *leaves: np.stack(leaves), *estimates)


def once(contacts, touched):
    """One run on the hexagon."""
    estimate = register(jax.random.key(1), SURFACES[0], jnp.eye(4), jnp.asarray(contacts), jnp.asarray(touched))
    return jax.tree.map(np.asarray, estimate)


def errors(estimated, true) -> np.ndarray:
    """Twists from the true to the estimated pose; their first order suffices for the remaining error of a degree."""
    return to_twist(np.linalg.inv(np.asarray(true, float)) @ np.asarray(estimated, float))


@pytest.mark.full
def test_corners_on_a_plane():
    """A tilted skin meets a plane with one corner p: the gap changes by the normal's part of t + w x p, so without
    residuals the covariance is that of a Bayesian linear regression, each row weighted as t's centre is.
    """
    rng = np.random.default_rng(0)
    half, height = PAD_WINDOW / 2, 30e-3  # of the hexagon's top
    poses, rows = [], []
    for _ in range(TOUCHES):
        down = Rotation.from_euler("xzx", [math.pi, rng.uniform(0, 6), 0.05])
        corners = down.apply(half * np.array([[i, j, 0] for i in (-1, 1) for j in (-1, 1)]))
        lowest = corners[corners[:, 2].argmin()]
        point = np.array([*rng.uniform(-10e-3, 10e-3, 2), height])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = down.as_matrix(), point - lowest
        poses.append(T)
        normal = np.array([0, 0, 1.0])
        rows.append([*normal, *(np.cross(point, normal) / TWIST_LEVER_M)])
    a = np.array(rows)
    precision = np.diag(SPREAD**-2.0) + (STUDENT_T_DOF + 1) / STUDENT_T_DOF * a.T @ a / NOISE**2
    estimate = once(np.float32(poses), np.ones(TOUCHES, bool))
    root = np.linalg.cholesky(precision)
    values = np.linalg.eigvalsh(root.T @ estimate.covariance.astype(float) @ root)
    # Ten factors (1 + r^2 / 4)^-2.5 have a variance 50 / 47 of what their curvature says, if all are of one kind; 3 of
    # them share each direction here, which gives up to 15 / 12. From 256 draws it is known to 9 %.
    noise = math.sqrt(2 / 256)
    assert values.min() > 1 - 2 * noise
    assert values.max() < 15 / 12 * (1 + 2 * noise)
    error = errors(estimate.T_w_o[None], np.eye(4)[None])[0]
    assert np.abs(root.T @ error).max() < 3 / math.sqrt(256)
    np.testing.assert_allclose(estimate.residual, 0, atol=1e-6)


@pytest.mark.full
@pytest.mark.parametrize("which", [0, 2])
def test_covariance_is_calibrated(which):
    """Squared errors in units of the covariance are chi square of six degrees: over 12 runs their mean is 6 within
    sqrt(12 / 12) = 1, taken four times. A spanner's edges make posteriors that are not normal.
    """
    true, estimates = runs(SURFACES[which], 3)
    error = errors(estimates.T_w_o, true)
    covariance = np.asarray(estimates.covariance, float)
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert abs(squared.mean() - 6) < 4 * math.sqrt(12 / RUNS)
    predicted = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2).mean(0)) / SPREAD
    left = np.sqrt((error**2).mean(0)) / SPREAD
    # Ten touches determine the height to 0.1 mm / sqrt(10), and tilts to that over their spread, 10 mm on the hexagon
    # and lengthwise on the spanner; what meets first is off the middle, which mixes the two: two and a half times as
    # much.
    predicted, left = (part[2:5] if which == 0 else part[[2, 4]] for part in (predicted, left))
    assert predicted[0] < 2.5 * NOISE / math.sqrt(TOUCHES) / DISTANCE
    assert (predicted[1:] < 2.5 * NOISE / math.sqrt(TOUCHES) / 10e-3 / ANGLE).all()
    assert (left < 1.6 * predicted).all()  # over 12 runs an rms is known to 20 %


@pytest.mark.full
def test_symmetric_directions_keep_the_prior():
    """Touches on the top of a prism determine height and tilts, but no touch determines the spin of a cylinder."""
    _, estimates = runs(SURFACES[1], 5, 4)
    spin = np.sqrt(np.asarray(estimates.covariance)[:, 5, 5]) / SPREAD[5]
    np.testing.assert_allclose(spin, 1, atol=0.02)  # its 71 sides are flat to 60 um
    assert np.abs(errors(estimates.T_w_o, np.tile(np.eye(4), (4, 1, 1)))[:, 5]).max() < 0.2 * SPREAD[5]


@pytest.mark.full
def test_touches_in_air_keep_the_prior():
    """Without any touch that counts, the result is the prior for any poses."""
    nowhere = jnp.full((TOUCHES, 4, 4), jnp.nan, jnp.float32)
    estimate = once(nowhere, jnp.zeros(TOUCHES, bool))
    np.testing.assert_allclose(estimate.T_w_o, np.eye(4), atol=1e-7)
    np.testing.assert_allclose(estimate.covariance, np.diag(SPREAD**2), rtol=1e-4, atol=1e-11)
    contacts = draw(jax.random.split(jax.random.key(0), RUNS), SURFACES[0])[1][0]
    some = jnp.arange(TOUCHES) < 6
    kept = once(contacts, some)
    masked = once(jnp.where(some[:, None, None], contacts, jnp.nan), some)
    np.testing.assert_array_equal(kept.T_w_o, masked.T_w_o)
    assert (kept.weight[6:] == 0).all()


@pytest.mark.full
def test_an_outlying_touch_does_not_shift_the_estimate():
    """One contact 5 mm too early weighs 5 / (4 + 50^2) = 0.002 and so pulls like one of 10 um, a tenth of the noise."""
    contacts, hit = (part[0] for part in draw(jax.random.split(jax.random.key(7), RUNS), SURFACES[0])[1:])
    wrong = contacts.at[4, 2, 3].add(5e-3)
    pulled = once(wrong, hit)
    without = once(wrong, hit & (jnp.arange(TOUCHES) != 4))
    assert pulled.weight[4] < 0.01
    apart = errors(pulled.T_w_o[None], without.T_w_o[None])[0]
    assert (np.abs(apart) < 0.2 * np.sqrt(np.diagonal(without.covariance))).all()


def test_padding_faces_are_not_candidates():
    """Rounding may give a face of three equal corners an area, and the face would then be met anywhere."""
    surface = prepare_surface(trimesh.creation.box((0.04, 0.04, 0.04)))
    assert len(surface.triangles) > 12
    corners = contacts.candidates(surface, jnp.eye(4).at[2, 3].set(0.02), 3e-3, 0.03, half_edge=0.01, count=128)
    assert (double_areas(jnp.moveaxis(corners, -1, 0).swapaxes(1, 2)) > 1e-4).all()


@pytest.mark.full
def test_another_edge_of_the_skin_compiles_nothing():
    surface = prepare_surface(trimesh.creation.box((0.04, 0.04, 0.04)))
    T_w_contact = np.diag([1.0, -1.0, -1.0, 1.0])[None] + np.eye(4)[3] * [[0.0], [0.0], [0.021], [0.0]]
    config = touch.TouchRegistrationConfig(num_starts=1, annealing_steps=2, steps=1, draws=16, rounds=1)
    arguments = surface, np.eye(4), T_w_contact, np.ones(1)
    register_by_touch(jax.random.key(0), *arguments, **prior, config=config)
    with compilations() as compiled:
        register_by_touch(jax.random.key(0), *arguments, **prior, config=replace(config, half_edge=5e-3))
    assert compiled == []


def test_steps_follow_the_gradient_of_students_t_log_density():
    """The residuals are linear in z, from a thousandth of the scale to thirty times it."""
    rng = np.random.default_rng(8)
    at, slope, weight = (rng.normal(size=size) for size in (9, (9, 6), 9))
    at, weight, scale = at * np.geomspace(1e-3, 30, 9), np.abs(weight), 0.7

    def linearised(z):
        return contacts.LinearisedContacts(jnp.float32(at) + jnp.float32(slope) @ z, jnp.float32(slope), jnp.ones(9))

    def cost(z):
        return contacts.cost(z, linearised(z), jnp.float32(weight), jnp.float32(scale))

    z = jnp.float32(0.1 * rng.normal(size=6))
    step = jax.jit(lambda z: contacts.normal_equations(z, linearised(z), jnp.float32(weight), jnp.float32(scale))[1])
    value, gradient = jax.jit(jax.value_and_grad(cost))(z)
    np.testing.assert_allclose(step(z), gradient, rtol=1e-4, atol=1e-4)
    density = weight @ stats.t(STUDENT_T_DOF).logpdf((at + slope @ np.asarray(z)) / scale)
    peak = weight.sum() * stats.t(STUDENT_T_DOF).logpdf(0)
    assert float(value) == pytest.approx(peak - density + 0.5 * float(z @ z), rel=1e-5)


def test_contact_of_recorded_touches():
    """The end of a press is moved back by its travel along tool z; touches without contact are left out."""
    T = np.asarray(random_motion(jax.random.key(0), 0.1, 1.0))
    codes = [ReturnCode.SKIN, ReturnCode.AIR, ReturnCode.WRENCH, ReturnCode.FAILED]
    touches = Touches(*[None] * len(Touches._fields))._replace(
        T_w_t=jnp.asarray(np.tile(T, (4, 1, 1))), travel=jnp.array([1e-3, jnp.nan, 2e-3, 1e-3]), code=jnp.array(codes)
    )
    poses, met = contact_poses(touches)
    assert met.tolist() == [True, False, True, False]
    for i, depth in ((0, 1e-3), (2, 2e-3)):
        np.testing.assert_allclose(np.linalg.inv(T) @ np.asarray(poses[i]) @ [0, 0, depth, 1], [0, 0, 0, 1], atol=1e-6)


CAMERA = Camera(320, 180, 161.2, 161.05, 159.5, 89.5)  # the paper's, every second pixel


def look_at(at: np.ndarray, degrees: float, distance: float = 0.25) -> np.ndarray:
    """T_w_c of a tilted camera that looks down at a point."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, :3] = T[:3, :3] @ Rotation.from_euler("yx", [degrees, degrees / 3], degrees=True).as_matrix()
    T[:3, 3] = at - distance * T[:3, 2]
    return T


def noisy_image(mesh, T_w_c: np.ndarray, rng: np.random.Generator, noise: float = 1e-3) -> np.ndarray:
    """Depth (m) of an object on a table, with noise."""
    table = trimesh.creation.box((0.6, 0.6, 0.01)).apply_translation([0, 0, -0.005])
    scene = trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), table])
    depth = image(scene, T_w_c, CAMERA)
    return (depth + rng.normal(0, noise, depth.shape)).astype(np.float32)


def off(rng: np.random.Generator, distance: float = 7e-3, degrees: float = 5.0) -> np.ndarray:
    """A motion of this length and angle in a random direction."""
    along, axis = rng.normal(size=(2, 3))
    T = np.eye(4)
    T[:3, 3] = distance * along / np.linalg.norm(along)
    T[:3, :3] = Rotation.from_rotvec(math.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    return T


@pytest.mark.parametrize(("name", "at"), [("hexagon", 0.0), ("hammer", 0.06), ("dome", 0.0)])
def test_depth_finds_the_pose(name, at):
    """About a thousand points with 1 mm noise determine a face to 0.03 mm, and a side that covers few rows to ten times
    that. A dome does not show its spin, and its facets, which are flat to 60 um, must have little effect.
    """
    rng, mesh = np.random.default_rng(1), make_object(name).mesh
    squared = []
    for degrees in (25, 35, 45, 55):
        T_w_c = look_at(np.array([at, 0, 15e-3]), degrees)
        estimate = register_by_depth(mesh, off(rng), noisy_image(mesh, T_w_c, rng), CAMERA, T_w_c)
        error = errors(estimate.T_w_o[None], np.eye(4)[None])[0]
        assert np.linalg.norm(error[:3]) < 1e-3
        if name != "dome":
            assert np.linalg.norm(error[3:]) < math.radians(1) * TWIST_LEVER_M
        squared.append(error @ np.linalg.solve(np.asarray(estimate.covariance, float), error))
        assert np.median(np.abs(estimate.residual)) < 1e-3
    if name != "dome":
        # Chi square of six degrees: the mean of four is 6 within sqrt(12 / 4); edges, where a point may belong to the
        # other face, add as much again.
        assert np.mean(squared) < 2 * (6 + 2 * math.sqrt(3))


def test_covariance_from_depth_includes_the_prior():
    """No direction becomes less certain: neither the spin of a dome, nor a position that was certain to 1 um, to which
    a thousand points with 1 mm noise add nothing.
    """
    rng, mesh = np.random.default_rng(5), make_object("dome").mesh
    T_w_c = look_at(np.array([0, 0, 15e-3]), 35)
    std, angle = 1e-6, 0.02
    estimate = register_by_depth(
        mesh, np.eye(4), noisy_image(mesh, T_w_c, rng), CAMERA, T_w_c, translation_std=std, rotation_std=angle
    )
    predicted = np.sqrt(np.diagonal(np.asarray(estimate.covariance, float)))
    np.testing.assert_allclose(predicted[:3], std, rtol=1e-2)
    assert (predicted[3:] < angle * TWIST_LEVER_M * (1 + 1e-6)).all()
    assert predicted[5] > 0.5 * angle * TWIST_LEVER_M


def test_errors_of_the_camera_move_the_object():
    rng = np.random.default_rng(0)
    distance, angle, count = 1e-3, math.radians(0.5), 20_000
    T_c_o = np.eye(4)
    T_c_o[:3, :3], T_c_o[:3, 3] = Rotation.from_rotvec([0.4, 2.0, -1.0]).as_matrix(), [0.02, -0.05, 0.2]
    moved = np.tile(np.eye(4), (count, 1, 1))  # the camera, seen from where it is believed
    moved[:, :3, 3] = distance * rng.normal(size=(count, 3))
    moved[:, :3, :3] = Rotation.from_rotvec(angle * rng.normal(size=(count, 3))).as_matrix()
    twists = to_twist(np.linalg.inv(T_c_o) @ moved @ T_c_o)
    before = np.diag(np.arange(1.0, 7.0)) * 1e-7
    predicted = camera_covariance(before, T_c_o, distance, angle)
    scale = np.sqrt(np.diagonal(predicted))
    np.testing.assert_allclose((before + np.cov(twists.T) - predicted) / np.outer(scale, scale), 0, atol=0.05)
    np.testing.assert_array_equal(camera_covariance(before, T_c_o, 0.0, 0.0), before)


def test_touches_that_cannot_be_registered_are_refused():
    rng, mesh = np.random.default_rng(0), make_object("hexagon").mesh
    T_w_c = look_at(np.array([0, 0, 15e-3]), 30)
    depth = noisy_image(mesh, T_w_c, rng)
    far, lifted = np.eye(4), np.eye(4)
    far[0, 3], lifted[2, 3] = 0.15, 0.7 * 30e-3
    # One of a third the size, its top on the real top, has a ninth of its area within reach of the rest.
    small = mesh._replace(vertices=0.3 * mesh.vertices)
    for given, word in (
        ((mesh, far, depth, CAMERA, T_w_c), "points lie within"),
        ((small, lifted, depth, CAMERA, T_w_c), "near the object fit its surface within 3 mm, but 30 % are needed"),
        ((mesh, far, depth, CAMERA, 2 * T_w_c), "T_w_c: is not a rigid"),
        ((mesh, far, depth[:-1], CAMERA, T_w_c), "has the shape"),
    ):
        with pytest.raises(ValueError, match=word):
            register_by_depth(*given)
    with pytest.raises(ValueError, match="give n poses"):
        register_by_touch(jax.random.key(0), SURFACES[0], jnp.eye(4), jnp.zeros((0, 4, 4)), jnp.zeros(0), **prior)
    poses, unknown = np.tile(np.eye(4), (3, 1, 1)), np.full((4, 4), np.nan)
    poses[1] = np.nan
    with pytest.raises(ValueError, match="1 touches have a non-finite pose or weight, the first in row 1"):
        register_by_touch(jax.random.key(0), SURFACES[0], jnp.eye(4), poses, np.ones(3), **prior)
    with pytest.raises(ValueError, match="T_w_o has non-finite numbers"):
        register_by_touch(jax.random.key(0), SURFACES[0], unknown, poses, np.array([1.0, 0.0, 1.0]), **prior)


@pytest.mark.full
def test_depth_of_a_real_camera(shared_data):
    """YCB-Video's own poses, fitted by others to the same Xtion, whose step is 1 mm: found again within 2 mm and 2
    degrees from 7 mm and 5 degrees off, among what else is in the image.
    """
    rng = np.random.default_rng(2)
    for item in OBJECTS:
        if item.name == "025_mug":  # its side shows no handle in these frames
            continue
        mesh = read_mesh(shared_data / "ycb_meshes" / f"{item.name}.stl", "m", table=False)[0].mesh
        camera, depths, _, T_c_o = frames(shared_data / "ycbvideo", item)
        for depth, T in zip(depths[::2], T_c_o[::2], strict=True):
            estimate = register_by_depth(mesh, T @ off(rng), depth, camera, np.eye(4), table_height=None)
            error = errors(estimate.T_w_o[None], T[None])[0]
            assert np.linalg.norm(error[:3]) < 2e-3
            assert np.linalg.norm(error[3:]) < math.radians(2) * TWIST_LEVER_M
