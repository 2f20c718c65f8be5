"""Poses on a table against rigid motions, and landscapes in closed form that are found wherever they stand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp

from i2t.geometry import from_twist
from i2t.recognition import belief, planar
from i2t.recognition.belief import TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.planar import PlanarGrid
from i2t.types import TWIST_LEVER_M

TABLE = PlanarGrid(half=10e-3, reach=15e-3, step=2.5e-3, turns=24)
LOADS, PAST, POSITION = (0.3, 0.9, 2.7), 20e-3, 0.1e-3
LIKE = belief.fit_likelihood(
    np.random.default_rng(0).normal(size=(60, 15)),
    jnp.ones(15),
    jnp.float32(LOADS),
    overtravel=PAST,
    position_std=POSITION,
)
LIKE = LIKE._replace(tactile_weight=jnp.float32(0.0))  # only where presses end


def standing(pose) -> np.ndarray:
    x, y, turn = pose
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])


@pytest.mark.full
def test_a_press_is_a_node_and_a_displacement():
    nodes, (cells, _) = planar.node_poses(TABLE), planar.pose_cells(TABLE)
    rng = np.random.default_rng(1)
    which = rng.integers(len(cells), size=50)
    angle, radius = rng.uniform(0, 2 * np.pi, 50), TABLE.reach * np.sqrt(rng.random(50))
    site = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)

    @jax.jit
    @jax.vmap
    def nearest(pose, at):
        node, beside = planar.nearest_node(TABLE, pose, at)
        return node, beside, from_twist(beside)

    node, beside, T = nearest(jnp.asarray(cells[which]), jnp.float32(site))
    for i in range(50):
        seen = np.linalg.inv(standing(cells[which[i]])) @ planar.vertical_press_pose(*site[i], 0.0, TABLE.height)
        moved = np.linalg.inv(np.asarray(T[i])) @ nodes[node[i]]
        np.testing.assert_allclose(moved, seen, atol=1e-6)  # turns and metres in float32
    assert np.abs(beside).max() <= TABLE.step / 2 * (1 + 1e-4)


def test_cells_tile_the_table():
    cells, places = planar.pose_cells(TABLE)
    assert len(np.unique(cells, axis=0)) == len(cells) == 8 * 8 * 24
    # Cells and what lies within them together have the variance of a uniform distribution over the square.
    np.testing.assert_allclose(cells[:, :2].var(0) + np.diag(places.covariance[0])[:2], (20e-3) ** 2 / 12, rtol=1e-4)
    assert np.sqrt(places.covariance[0, 5, 5]) / TWIST_LEVER_M == pytest.approx(2 * np.pi / 24 / np.sqrt(12), rel=1e-5)


# Two landscapes, metres over the table: a lopsided hill, and its mirror image, which no turn makes the same.
def hill(x, y, mirrored):
    y = -y if mirrored else y
    return 20e-3 + 0.15 * x + 6e-3 * jnp.sin(x / 9e-3) * jnp.cos(y / 7e-3) + 5e-3 * jnp.sin((x + 2 * y) / 16e-3)


def landscape(mirrored: bool) -> PredictedTouch:
    """Presses on a landscape at all nodes: approach distances fall with the height, and with its slope as it moves."""
    at = jnp.asarray(planar.node_poses(TABLE)[:, :2, 3])
    height, (dx, dy) = hill(at[:, 0], at[:, 1], mirrored), jax.vmap(jax.grad(hill, (0, 1)), (0, 0, None))(
        at[:, 0], at[:, 1], mirrored
    )  # fmt: skip
    n, zero = len(at), jnp.zeros(len(at))
    around = (at[:, 0] * dy - at[:, 1] * dx) / TWIST_LEVER_M
    slope = jnp.stack([dx, dy, zero, zero, zero, around], -1)  # an object moved by x shows a place x before
    return PredictedTouch(jnp.ones(n, bool), TABLE.height - height, slope, jnp.zeros((n, 3)), jnp.zeros((n, 3, 15)),
                   jnp.zeros((n, 3)))  # fmt: skip


@pytest.mark.full
def test_landscapes_are_found_wherever_they_stand():
    both = jax.tree.map(lambda *x: jnp.stack(x, 1), landscape(False), landscape(True))
    cells, places = planar.pose_cells(TABLE)
    cells = jnp.asarray(cells)
    rng = np.random.default_rng(2)
    touches, force = 15, 0.9

    @jax.jit
    def judge(start, site, measured):
        def step(now, touched):
            now = planar.update(now, touched[1], touched[0], cells=cells, predicted=both, likelihood=LIKE, grid=TABLE)
            return now, None

        now, _ = jax.lax.scan(step, start, (site, measured))
        return belief.posterior(now), planar.most_probable_poses(now, cells, TABLE)

    start = belief.init(places, 2, channels=15)
    off = []
    for episode in range(6):
        truth = episode % 2
        pose = rng.uniform(-1, 1, 3) * [TABLE.half, TABLE.half, np.pi]
        site = rng.uniform(-1, 1, (touches, 2)) * TABLE.reach / np.sqrt(2)
        seen = np.linalg.inv(standing(pose)) @ np.stack([*site.T, np.zeros(touches), np.ones(touches)])
        advance = TABLE.height - np.asarray(hill(seen[0], seen[1], bool(truth))) + force / belief.ARM_STIFFNESS_N_PER_M
        measured = TouchObservation(
            jnp.zeros((touches, 15)), jnp.full(touches, force), jnp.float32(advance), jnp.ones(touches, bool)
        )
        p, stood = judge(start, jnp.float32(site), measured)
        assert p[truth] > 0.99
        found = np.asarray(stood.pose[truth])
        around = (found[2] - pose[2] + np.pi) % (2 * np.pi) - np.pi
        off.append([*(found[:2] - pose[:2]), around])
        near = planar.condition_on_pose(start, cells, jnp.float32(pose), jnp.float32([2e-3, 2e-3, 0.1]))
        np.testing.assert_allclose(logsumexp(near.log_weight, axis=1), np.log(1 / 2), atol=1e-5)
        q, _ = judge(near, jnp.float32(site), measured)
        assert q[truth] > 0.99
    # Finer than the grid: 0.72 mm and 4.3 degrees are the standard deviations within a cell.
    assert np.abs(off)[:, :2].max() < 1e-3
    assert np.degrees(np.abs(off)[:, 2]).max() < 4
