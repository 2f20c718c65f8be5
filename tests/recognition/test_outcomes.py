"""Imagined touches against plane geometry, finite differences and statics.

An approach distance is a difference of places of some 0.1 m in float32, wrong by up to DELTA as in `tests.test_touch`.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from i2t.objects.catalogue import make_object
from i2t.objects.drawing import ball, mesh_from_solid
from i2t.patches.dimensions import PAD_WINDOW, STANDOFF, TWIST_LEVER_M
from i2t.recognition import outcomes
from i2t.recognition.outcomes import PredictedContact, PredictedTouch
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, stack_surfaces
from i2t.skin.elasticity import CELL_GRID
from i2t.skin_models.reading_model import LOADS_N

pytestmark = pytest.mark.full

DELTA = 3e-7  # m
HALF = PAD_WINDOW / 2
PAST = 6e-3
LOAD = jnp.float32(LOADS_N)
DOWN = np.diag([1.0, -1.0, -1.0])
RADIUS = 25e-3
MANY = 26  # touches at a time: two for each coordinate of a placement, and two more of these
MESHES = make_object("square").mesh, mesh_from_solid(ball(25.0))
BLOCK, BALL = (element(stack_surfaces([prepare_surface(mesh) for mesh in MESHES]), i) for i in range(2))
TOP = 30e-3  # m, height of the block, 50 mm wide

meet = jax.jit(jax.vmap(partial(outcomes.predict_contact, overtravel=PAST), (None, None, 0, 0, None)))
interpolate_load = jax.jit(jax.vmap(outcomes.interpolate_load, (None, None, 0)))


def met(surface, T_w_o, twist, T_w_site) -> PredictedContact:
    """Some touches, in one compilation for all tests; a single site or position if there is only one."""
    twist, T = np.atleast_2d(twist), np.asarray(T_w_site).reshape(-1, 4, 4)
    twists, sites = (jnp.float32(np.resize(x, (MANY, *x.shape[1:]))) for x in (twist, T))
    full = meet(surface, jnp.float32(T_w_o), twists, sites, LOAD)
    return jax.tree.map(lambda x: np.asarray(x[: max(len(twist), len(T))]), full)


def pose(rotation, position) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


def tilted(rng: np.random.Generator, size: float) -> np.ndarray:
    """A tool that points down, with a tilt and a rotation."""
    return Rotation.from_euler("xyz", [*rng.uniform(0.3, 1, 2) * size * rng.choice([-1, 1], 2), 1.0]).as_matrix() @ DOWN


def test_a_flat_top_is_met_by_the_lowest_corner_of_the_skin():
    rng = np.random.default_rng(0)
    T_w_o = pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.1, 0.1, 3))
    places = [[*rng.uniform(-5e-3, 5e-3, 2), TOP + rng.uniform(-5e-3, 5e-3)] for _ in range(12)]
    sites = [pose(tilted(rng, 0.2), place) for place in places]
    contacts = met(BLOCK, T_w_o, np.zeros(6), T_w_o[None] @ np.stack(sites))
    assert contacts.hit.all()
    for i, site in enumerate(sites):
        R, p = site[:3, :3], site[:3, 3]
        corner, cosine = -np.sign(R[2, :2]) * HALF, -R[2, 2]
        height = p[2] + R[2, :2] @ corner - TOP
        assert contacts.approach_distance[i] == pytest.approx(height / cosine, abs=2 * DELTA)
        # A plane that moves up by v shortens the approach distance by v over the cosine; a turn w moves it up by w x q
        # at q.
        q = p + R[:, :2] @ corner + R[:, 2] * height / cosine
        slope = -np.array([0, 0, 1, q[1] / TWIST_LEVER_M, -q[0] / TWIST_LEVER_M, 0]) / cosine
        np.testing.assert_allclose(contacts.jacobian[i], slope, atol=1e-4)  # q moves by DELTA, of 9 mm


def test_slopes_are_differences_of_approach_distances():
    rng = np.random.default_rng(1)
    step = 1e-4
    T_w_o = pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.1, 0.1, 3))
    off = np.float32(rng.normal(scale=3e-3, size=(2, 6)))  # up to half a radian
    places = np.concatenate([off, *(off + sign * step * e for e in np.eye(6) for sign in (-1, 1))])
    R = tilted(rng, 0.4)
    top, pole = pose(R, [2e-3, -3e-3, TOP]), pose(R, np.array([0, 0, RADIUS]) - RADIUS * R[:, 2])
    # What is met goes around the object's origin on an arm no longer than this. A ball has facets; the skin meets one
    # of their corners, and a turn may change which: a kink within a step makes its difference wrong by half its bend,
    # beyond that of the arc.
    arm = 2 * RADIUS
    turns = np.array([0, 0, 0, 1, 1, 1])[:, None]
    for surface, site, facets in ((BLOCK, top, 0), (BALL, pole, 1)):
        contacts = met(surface, T_w_o, places, T_w_o @ site)
        assert contacts.hit.all()
        assert np.abs(contacts.approach_distance).max() > 1e-4
        apart = contacts.approach_distance[2:].reshape(6, 2, 2).astype(np.float64)  # (coordinate, sign, place)
        difference = (apart[:, 1] - apart[:, 0]) / (2 * step)
        bend = np.abs(apart.sum(1) - 2 * contacts.approach_distance[:2]) / step
        smooth = arm / TWIST_LEVER_M**3 * step**2 + DELTA / step  # of approach distances wrong by DELTA
        kink = 0.5 * facets * turns * (bend + arm / TWIST_LEVER_M**2 * step)
        assert (np.abs(contacts.jacobian[:2].T - difference) < smooth + kink).all()
        assert np.abs(contacts.jacobian).max() > 0.5


def test_a_miss_reads_zero_and_not_nan():
    # Beside the block; above it by a little more and a little less than the overtravel; below it, where an approach
    # that begins a millimetre below the bottom leads away from it.
    places = [60e-3, 0, TOP], *([0, 0, TOP + PAST + off] for off in (4 * DELTA, -4 * DELTA)), [0, 0, -STANDOFF - 1e-3]
    contacts = met(BLOCK, np.eye(4), np.zeros(6), np.stack([pose(DOWN, place) for place in places]))
    np.testing.assert_array_equal(contacts.hit, [False, False, True, False])
    np.testing.assert_allclose(contacts.approach_distance, PAST, atol=5 * DELTA)
    for values in (contacts.jacobian, contacts.indentation, contacts.newtons):
        np.testing.assert_array_equal(values[[0, 1, 3]], 0)
    assert all(np.isfinite(x).all() for x in contacts)


def test_the_skin_carries_the_load_and_sinks_deeper_with_it():
    flat, round_ = pose(DOWN, [0, 0, TOP]), pose(DOWN, [1e-3, 2e-3, 2 * RADIUS])
    for surface, site in ((BLOCK, flat), (BALL, round_)):
        contacts = met(surface, np.eye(4), np.zeros(6), site)
        assert contacts.newtons.min() >= 0
        # Rescaled to the load: 400 cells are summed in float32.
        np.testing.assert_allclose(contacts.newtons.sum(-1), np.float32([LOADS_N]), rtol=400 * np.finfo(np.float32).eps)
        assert (np.diff(contacts.indentation[0], prepend=0) > 0).all()
    # Where the ball is met is where it presses: its centre of pressure lies under the pole.
    x = (np.arange(CELL_GRID.cells) + 0.5) * CELL_GRID.spacing - HALF
    newtons = contacts.newtons[0].reshape(-1, CELL_GRID.cells, CELL_GRID.cells)
    centre = np.einsum("lij,j->l", newtons, x) / LOADS_N, np.einsum("lij,i->l", newtons, x) / LOADS_N
    # The tool's x is the world's and its y is turned over; a cell wide, the centre is known to a part of it.
    np.testing.assert_allclose(centre, np.array([[-1e-3], [2e-3]]) * np.ones(3), atol=0.25e-3)


# --- between loads ----------------------------------------------------------------------------------------------------


@pytest.fixture
def outcome() -> PredictedTouch:
    """A touch at the three loads."""
    rng = np.random.default_rng(6)
    sunk, variance = np.cumsum(rng.uniform(1e-4, 3e-4, 3)), rng.uniform(0.1, 1, 3) * np.array(LOADS_N) ** 2
    reading = rng.normal(scale=20, size=(3, 15)) * np.array(LOADS_N)[:, None]
    values = (jnp.float32(x) for x in (1e-3, np.zeros(6), sunk, reading, variance))
    return PredictedTouch(jnp.array(True), *values)


def test_touches_are_interpolated_between_loads(outcome):
    force = np.geomspace(0.1, 8.1, 61)  # from a third of the least load to three times the largest, which are knots
    sunk, reading, variance = (np.asarray(x, np.float64) for x in interpolate_load(outcome, LOAD, jnp.float32(force)))
    knots = [np.argmin(np.abs(force - load)) for load in LOADS_N]
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-9)  # logarithms and their powers in float32
    close(sunk[knots], outcome.indentation)
    close(reading[knots], outcome.reading, atol=1e-4 * 20)
    close(variance[knots], outcome.variance)
    assert (np.diff(sunk) > 0).all()
    assert (variance > 0).all()
    # Straight lines in the logarithm of the load, which go on beyond the outer knots, as NumPy draws them.
    for values, at in (
        (reading / force[:, None], np.asarray(outcome.reading) / np.array(LOADS_N)[:, None]),
        (np.log(sunk)[:, None], np.log(outcome.indentation)[:, None]),
        (np.log(variance / force**2)[:, None], np.log(outcome.variance / LOAD**2)[:, None]),
    ):
        first, second = at[:2], at[1:]
        low = force[:, None] < LOADS_N[1]
        part = np.log(force[:, None] / np.where(low, LOADS_N[0], LOADS_N[1])) / np.log(3)
        start, end = np.where(low, first[:1], second[:1]), np.where(low, first[1:], second[1:])
        np.testing.assert_allclose(values, start + part * (end - start), atol=1e-4 * np.abs(at).max())


def test_a_touch_fades_to_none_with_its_load(outcome):
    """Below the least load the indentation goes on as the power of the load that it is between the first two; readings
    per newton are constant from a step between loads below the least; extremes are finite, and misses nothing.
    """
    force = np.geomspace(1e-4, LOADS_N[0], 61)
    indentation, reading, variance = (
        np.asarray(x, np.float64) for x in interpolate_load(outcome, LOAD, jnp.float32(force))
    )
    first, second = np.asarray(outcome.indentation, np.float64)[:2]
    power = np.log(second / first) / np.log(LOADS_N[1] / LOADS_N[0])
    np.testing.assert_allclose(indentation, first * (force / LOADS_N[0]) ** power, rtol=1e-4)
    for values in (indentation, np.linalg.norm(reading, axis=1), variance):
        assert values[0] < 0.05 * values[-1]
    per_newton = (reading / force[:, None])[force < LOADS_N[0] / 3]
    np.testing.assert_allclose(per_newton, np.broadcast_to(per_newton[0], per_newton.shape), rtol=1e-4, atol=1e-3)

    extremes = jnp.resize(jnp.array([0.0, -1.0, 1e-12, 1e4, 0.02]), 61)
    nothing = jax.tree.map(jnp.zeros_like, outcome)
    for values, none in zip(
        interpolate_load(outcome, LOAD, extremes), interpolate_load(nothing, LOAD, extremes), strict=True
    ):
        assert np.isfinite(values).all()
        np.testing.assert_array_equal(values[:2], 0)
        np.testing.assert_array_equal(none, 0)
