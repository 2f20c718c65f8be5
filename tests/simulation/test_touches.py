"""Simulated touches in a world whose only errors are where the object stands and how soft the skin has become; then
each other error by itself.

True poses are drawn again from the keys, and views and readings are computed from them by other means.
"""

from dataclasses import fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers.compilations import compilations
from helpers.field_types import wrong_fields
from helpers.random_touches import assert_equal
from scipy import stats
from scipy.spatial.transform import Rotation

from i2t import geometry
from i2t.contact import approach
from i2t.contact.press import PressLimits
from i2t.dataset import Dataset, load_dataset, save_dataset
from i2t.patches.dimensions import PAD_WINDOW, REACH, VIEW_PIXELS, VIEW_WINDOW
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, render_heights, stack_surfaces
from i2t.simulation import sites
from i2t.simulation.touches import (
    CAMERA_DISTANCE_M,
    SessionErrors,
    SimulationErrors,
    apply_camera_model,
    sample_session_errors,
    simulate_touch,
    simulate_touches,
)
from i2t.skin.boards import make_board
from i2t.skin.contact import Grid
from i2t.skin.faults import FAULT_MODEL, Faults
from i2t.skin.pad import sample_pad
from i2t.types import Pad, ReturnCode, Surface, Touches

# The last press is worked out once more, on as many cells in a longer period, which the skin's own convergence says
# changes it by less than 2 % (tests/skin); the stop before it is within 0.1 % of its limit (test_press).
LIMITS = PressLimits(overshoot=0.0, final=Grid(40, 68))
WITHIN = 0.02
PLACED = replace(
    SimulationErrors.error_free(), placement=4e-3, placement_angle=np.radians(1.0).item(), faults=Faults(softening=0.5)
)
RUNS, N = 3, 6  # touches of a run, touches of an object
SEED = 5  # one of the four objects drawn lies too low to be met
PITCH = VIEW_WINDOW / VIEW_PIXELS
X, Y = np.meshgrid(*[(np.arange(VIEW_PIXELS) - (VIEW_PIXELS - 1) / 2) * PITCH] * 2)
PATCH = slice(12, 60)  # the central 48 of 72 pixels
ROUNDING = 2e-7  # m: two dozen roundings of coordinates below 0.1 m
# Cells of 0.5 mm meet a corner up to half a diagonal aside. Where a flat skin rests on a corner of the ball, it is less
# steep to a face than faces of one corner are to one another: 42 degrees.
LATE = 0.25e-3 * np.sqrt(2) * np.tan(np.radians(42))
many = partial(simulate_touches, errors=PLACED, n=N, limits=LIMITS, touches_per_session=RUNS)


@pytest.fixture(scope="module")
def solids() -> list[Surface]:
    meshes = trimesh.creation.icosphere(1, 0.03), trimesh.creation.box((0.06, 0.06, 0.06))
    stacked = stack_surfaces([prepare_surface(mesh.apply_translation((0, 0, 0.03))) for mesh in meshes])
    return [element(stacked, i) for i in range(2)]  # of one size class: one compilation


@pytest.fixture(scope="module")
def pad() -> Pad:
    """A pad with sixteen chips and without friction, which does not influence the end of a press."""
    return sample_pad(jax.random.key(3), board=make_board("grid-4x4"))._replace(friction=jnp.zeros(()))


@pytest.fixture(scope="module")
def touches(solids, pad) -> Touches:
    counts: list[int] = []
    simulated = many(jax.random.key(SEED), solids, pad, progress=counts.append)
    assert counts == [3, 3, 3, 3]
    return simulated


@pytest.fixture(scope="module")
def true_poses(touches) -> np.ndarray:
    """T_o_t of the reported poses, where each object really stood."""
    runs = [jax.random.split(jax.random.fold_in(jax.random.key(SEED), run), 3)[0] for run in range(4)]
    placed = np.array([sample_session_errors(key, PLACED).T_o_placed for key in runs], np.float64)
    return np.linalg.inv(placed)[touches.session] @ touches.T_w_t


def along_z(T: np.ndarray, distance: float) -> np.ndarray:
    return T @ geometry.transform(np.eye(3), np.array([0, 0, distance]))


@pytest.fixture(scope="module")
def first_contact(solids):
    """Compute the distance (m) from a pose T_o_t to first contact with object i."""
    press = jax.jit(approach.first_contact)

    def ahead(i: int, T: np.ndarray) -> float:
        contact = press(solids[i], jnp.float32(T))
        assert contact.hit
        return float(contact.distance)

    return ahead


def behind(z: np.ndarray, nearest: float) -> np.ndarray:
    return np.clip(np.where(np.isfinite(z), z, 1.0) - nearest, 0, REACH)


def test_all_errors_of_a_lab_are_above_zero_unless_disabled():
    for errors, sign in (
        (SimulationErrors(), 1),
        (SimulationErrors.error_free(), 0),
        (SimulationErrors().scaled(0.0), 0),
    ):
        sizes = [getattr(errors, error.name) for error in fields(errors)]
        np.testing.assert_array_equal(np.sign(sizes[: SimulationErrors.num_pose_errors]), sign)
        np.testing.assert_array_equal(np.sign(sizes[SimulationErrors.num_pose_errors : -2]), errors.force > 0)
    assert SimulationErrors().scaled(0.0).noise == SimulationErrors().noise != SimulationErrors.error_free().noise


@pytest.mark.full
def test_runs_and_objects_are_counted_and_kept(touches, pad, tmp_path):
    assert touches.object.tolist() == [0] * 6 + [1] * 6
    assert touches.session.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert touches.T_w_o.tolist() == [np.eye(4).tolist()] * 12
    assert wrong_fields(touches) == []
    dataset = Dataset(touches, ("ball", "box"), ("pad",), tuple("abcd"), pad.board, "simulated")
    assert_equal(load_dataset(save_dataset(tmp_path / "touches.h5", dataset)), dataset)


@pytest.mark.full
def test_the_camera_and_the_skin_meet_the_object_at_its_true_pose(touches, true_poses, solids):
    render = jax.jit(lambda surface, T: render_heights(surface, geometry.inverse(T), VIEW_WINDOW, VIEW_PIXELS))
    truth, on_pad = touches.truth, np.maximum(np.abs(X), np.abs(Y)) < PAD_WINDOW / 2
    for i, T in enumerate(true_poses):
        surface = solids[int(touches.object[i])]
        z = np.asarray(render(surface, jnp.float32(T)))
        # A ray on an edge may fall to either side where a pose is rounded in another order.
        assert np.mean(np.abs(touches.view[i] - behind(z, touches.nearest[i])) < ROUNDING) > 0.995
        np.testing.assert_array_equal(touches.patch[i], touches.view[i, PATCH, PATCH])
        # A mean of 5 x 5 pixels lies behind the nearest, by at most two of them along each slope (below 45 degrees).
        assert -ROUNDING < touches.nearest[i] - z[PATCH, PATCH].min() < 2 * 2 * PITCH
        if touches.code[i] != ReturnCode.AIR:
            # The skin stays behind the reported pose by what force bends arm and mount.
            z = np.asarray(render(surface, jnp.float32(along_z(T, -truth.force[i] / LIMITS.stiffness))))
            assert abs(truth.nearest[i] - z[on_pad].min()) < ROUNDING
            assert np.mean(np.abs(truth.view[i] - behind(z, truth.nearest[i])) < 2 * ROUNDING) > 0.995
            # Pixels and the skin's cells meet the nearest point, each late by less than that.
            assert abs(truth.nearest[i] + truth.indentation[i]) < LATE


@pytest.mark.full
def test_a_press_ends_past_first_contact_by_indentation_and_compliance_or_in_air(touches, true_poses, first_contact):
    air = touches.code == ReturnCode.AIR
    assert len(np.unique(touches.session[air])) == 1
    for i, T in enumerate(true_poses):
        ahead = first_contact(int(touches.object[i]), T)
        if air[i]:  # it went to the end of its search, and what it looked for begins further on
            assert ahead > 0
            assert touches.nearest[i] > 0
            assert np.isnan(touches.travel[i])
            assert not touches.reading[i].any()
            assert not touches.truth.reading[i].any()
            assert touches.force[i] == touches.truth.indentation[i] == 0
        else:
            assert abs(-ahead - touches.travel[i]) < ROUNDING
            late = -ahead - touches.truth.indentation[i] - touches.truth.force[i] / LIMITS.stiffness
            assert -ROUNDING < late < LATE


def test_only_whole_numbers_and_grids_of_a_world_decide_which_program_it_runs():
    structure = jax.tree.structure
    assert structure(SimulationErrors()) == structure(SimulationErrors.error_free().scaled(2.0))
    assert structure(PressLimits()) == structure(PressLimits(force=3.0, overshoot=0.0)) != structure(LIMITS)
    assert structure(sites.SiteLimits()) == structure(sites.SiteLimits(min_cos=0.5))
    assert structure(Faults()) == structure(Faults.typical()) != structure(Faults(ambient_every=10))


@pytest.mark.full
def test_other_errors_and_limits_compile_nothing(touches, solids, pad):
    limits, safety = replace(LIMITS, skin_change=20.0, force=5.0), sites.SiteLimits(min_cos=0.4, max_rise=2e-3)
    with compilations() as compiled:
        other = many(jax.random.key(SEED), solids[:1], pad, errors=SimulationErrors(), n=3, limits=limits, sites=safety)
    assert compiled == []
    met = other.code == ReturnCode.SKIN
    assert met.any()
    assert (
        np.abs(np.linalg.norm(other.truth.reading[met], axis=1) / limits.skin_change - 1).max()
        < 5 * limits.overshoot + WITHIN
    )
    assert np.linalg.norm(other.reading - other.truth.reading, axis=1).min() > 1  # uT, of the chips' noise


@pytest.mark.full
def test_presses_end_at_the_limit_and_readings_grow_as_the_skin_softens(touches):
    truth, met = touches.truth, touches.code != ReturnCode.AIR
    assert (touches.code[met] == ReturnCode.SKIN).all()
    np.testing.assert_allclose(np.linalg.norm(truth.reading[met], axis=1), LIMITS.skin_change, rtol=WITHIN)
    assert (truth.force < LIMITS.force).all()
    np.testing.assert_array_equal(touches.force, truth.force)
    # Without noise the sensor gives the true reading, which grows by what the presses of all sessions before wore off.
    worn = 1 + 0.5 * (1 - np.exp(-np.arange(2 * N) / FAULT_MODEL.wear_presses))
    assert worn[-1] > 1 + 2 * WITHIN
    np.testing.assert_allclose(touches.reading, truth.reading * worn[:, None], rtol=1e-4, atol=1e-3)


@pytest.mark.full
def test_measured_force_and_travel_have_the_stated_errors_and_a_slant_acts_by_friction(solids):
    """The presses are on the top of the box, whose height is the same at all poses of the arm."""
    pad, n = sample_pad(jax.random.key(3)), 12
    T_w_site = jnp.diag(jnp.asarray([1.0, -1.0, -1.0, 1.0])).at[2, 3].set(0.06)
    errors = replace(SimulationErrors.error_free(), force=0.2, slant=np.radians(2.0).item(), repeatability=0.1e-3)
    press = partial(
        simulate_touch, session=SessionErrors(jnp.eye(4), jnp.eye(4)), errors=errors, limits=PressLimits(overshoot=0.0)
    )

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None))
    def pressed(key, friction):
        return press(key, solids[1], jnp.eye(4), T_w_site, pad=pad._replace(friction=friction))

    keys = jax.random.split(jax.random.key(8), n)
    smooth, rough = (
        jax.device_get(pressed(jax.random.clone(keys), friction)) for friction in (jnp.zeros(()), pad.friction)
    )
    for touches in (smooth, rough):
        assert stats.kstest((touches.force - touches.truth.force) / 0.2, "norm").pvalue > 1e-6
        travelled = touches.truth.indentation + touches.truth.force / PressLimits.stiffness
        assert stats.kstest((touches.travel - travelled) / 0.1e-3, "norm").pvalue > 1e-6
    # A flat top feels alike everywhere, and a press ends as it would straight on.
    np.testing.assert_allclose(smooth.truth.reading, np.broadcast_to(smooth.truth.reading[:1], (n, 15)), atol=1e-3)
    np.testing.assert_allclose(rough.truth.force, smooth.truth.force, rtol=WITHIN)
    change = np.linalg.norm(rough.truth.reading - smooth.truth.reading, axis=1)
    assert np.median(change) > 0.01 * LIMITS.skin_change


@pytest.mark.full
def test_the_key_determines_all_draws_and_an_object_without_safe_sites_is_named(touches, solids, pad):
    few = many(jax.random.key(SEED), solids[:1], pad, n=[3])  # and fewer touches are the first ones
    for name in ("patch", "reading", "force", "travel", "T_w_t", "code"):
        np.testing.assert_array_equal(getattr(few, name), getattr(touches, name)[:3])
    other = many(jax.random.key(SEED + 1), solids[:1], pad, n=[3])
    assert (np.linalg.norm((other.T_w_t - touches.T_w_t[:3])[:, :3, 3], axis=1) > 1e-4).all()
    # No two touches of a run, and no two runs, are alike.
    assert len(np.unique(touches.T_w_t[:, :3, 3].round(6), axis=0)) == 12
    inside_out = trimesh.creation.box((0.06, 0.06, 0.06)).apply_translation((0, 0, 0.03))
    inside_out.invert()  # only its floor looks up
    with pytest.raises(ValueError, match=r"object 1 has too few safe touch sites; relax"):
        many(jax.random.key(0), [solids[0], prepare_surface(inside_out)], pad, n=[0, 4])


def test_pose_errors_have_their_stated_spread():
    errors, n = SimulationErrors(), 4000
    run = jax.jit(jax.vmap(partial(sample_session_errors, errors=errors)))(jax.random.split(jax.random.key(0), n))
    for T, distance, angle in (
        (run.T_o_placed, errors.placement, errors.placement_angle),
        (run.T_t_camera, errors.hand_eye, errors.hand_eye_angle),
    ):
        turned = Rotation.from_matrix(np.asarray(T[:, :3, :3], np.float64)).as_rotvec()
        for values, spread in ((np.asarray(T[:, :3, 3]), distance), (turned, angle)):
            # A standard deviation of n normal values scatters by 1 / sqrt(2 n), a mean by 1 / sqrt(n); 4.5 of each.
            np.testing.assert_allclose(values.std(0), spread, rtol=4.5 / np.sqrt(2 * n))
            np.testing.assert_allclose(values.mean(0), 0, atol=4.5 * spread / np.sqrt(n))
    both = np.concatenate([run.T_o_placed[:, :3, 3], run.T_t_camera[:, :3, 3]], axis=1)
    assert np.abs(np.corrcoef(both.T) - np.eye(6)).max() < 4.5 / np.sqrt(n)


# The camera, on a plane that falls to the right by 0.64 mm on either side.

SLOPE = 0.05
PLANE = SLOPE * X
FREE = slice(24, 64)  # columns more than 0.19 mm behind the nearest mean: no error here reaches the clip at it
camera = jax.jit(apply_camera_model, static_argnames="errors")


def seen(z: np.ndarray, **errors: float) -> np.ndarray:
    """Heights in the view."""
    patch, depth = camera(jax.random.key(0), jnp.float32(z), errors=replace(SimulationErrors.error_free(), **errors))
    return np.asarray(depth, np.float64) + float(patch.nearest)


def test_depth_noise_has_its_stated_size():
    noise = 20e-6  # FREE is nine of these behind the clip
    error = (seen(PLANE, depth_noise=noise) - PLANE)[:, FREE]
    # Standard deviations, means and correlations of independent normal values: 4.5 of their own deviations.
    assert abs(error.std() / noise - 1) < 4.5 / np.sqrt(2 * error.size)
    assert abs(error.mean()) < 4.5 * noise / np.sqrt(error.size) + ROUNDING
    assert abs(np.corrcoef(error[:, 1:].ravel(), error[:, :-1].ravel())[0, 1]) < 4.5 / np.sqrt(error.size)


def test_depth_comes_in_steps():
    quantum = 0.1e-3
    z = seen(PLANE, depth_quantum=quantum)[:, FREE]
    steps = (z + CAMERA_DISTANCE_M) / quantum
    np.testing.assert_allclose(steps, steps.round(), atol=ROUNDING / quantum)
    assert np.abs(z - PLANE[:, FREE]).max() <= quantum / 2 + ROUNDING
    assert len(np.unique(steps.round())) > 5


def test_bleeding_moves_pixels_sideways():
    error = (seen(PLANE, depth_bleed=1.0) - PLANE)[:, FREE] / (SLOPE * PITCH)
    shifts = error.round()
    np.testing.assert_allclose(error, shifts, atol=ROUNDING / (SLOPE * PITCH))  # whole pixels
    # A rounded unit normal has variance 1 + 1/12 (Sheppard, to 1e-3); that of a variance is 2 / n of its square.
    assert abs(shifts.var() / (13 / 12) - 1) < 4.5 * np.sqrt(2 / shifts.size) + 1e-3

    z = seen(np.where(X < 0, 0.0, 3e-3), depth_bleed=1.0)
    near, far = np.abs(z) < ROUNDING, np.abs(z - 3e-3) < ROUNDING
    assert (near | far).all()  # nothing between the two surfaces
    assert near[:, : 36 - 6].all()  # a shift of six pixels is a normal value beyond 5.5: 4 in 100 million
    assert far[:, 36 + 6 :].all()
    crossing = 0.3085  # P(normal > 0.5)
    for column in (near[:, 36], far[:, 35]):
        assert abs(column.mean() - crossing) < 4.5 * np.sqrt(crossing * (1 - crossing) / 72)
