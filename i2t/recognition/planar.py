"""Objects that stand anywhere on a table, turned in any way: a posterior over object and planar pose.

A press straight down at a point of the table meets an object at some point of the object's own frame, from some
direction. So touches of every object are predicted once for a grid of points and turns in its own frame
(`node_poses`), and serve every press on it wherever it stands. Poses are cells of a grid over the table with the same
turns (`pose_cells`): a pose and a press lead to the nearest node and to the displacement from it (`nearest_node`). The
rest is `i2t.recognition.belief`: each cell carries a normal distribution of the remaining pose error, and the offset
from the node is one more such displacement, which the Jacobian of the approach distance accounts for.

Object frames stand on z = 0 with z up. Metres, radians; a pose is (x, y, turn) of the object in the world.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float, Int

from i2t.recognition import belief
from i2t.recognition.belief import Belief, Likelihood, Particles, TouchObservation
from i2t.recognition.outcomes import PredictedTouch
from i2t.types import TWIST_LEVER_M


@dataclass(frozen=True)
class PlanarGrid:
    """Ranges of objects' poses and presses, and the resolution of both."""

    half: float = 20e-3  # m: objects stand within a square of +-half about the origin
    reach: float = 25e-3  # m: presses go to points at most so far from the origin
    step: float = 2.5e-3  # m
    turns: int = 48  # directions in a full turn
    height: float = 30e-3  # m over the table, of the sites of presses
    inflation: float = 1.7  # of readings' errors, as readings are those of the nearest node; of validation objects

    @property
    def extent(self) -> float:
        """Largest distance (m) of a press from an object's origin."""
        return float(self.reach + np.sqrt(2) * self.half)

    @property
    def across(self) -> int:
        """Nodes along an axis of an object."""
        return 2 * int(np.ceil(self.extent / self.step)) + 1


class PlanarPose(NamedTuple):
    """Pose of an object, if it is the one that is there."""

    pose: Float[Array, "*objects 3"]  # x, y, turn: mean over the most probable cell and those near it
    share: Float[Array, "*objects"]  # probability of those cells


def object_frame_pose(pose: Float[Array, "3"], site: Float[Array, "2"]) -> Float[Array, "2"]:
    """A point of the table in the frame of an object.

    Args:
        pose: Of the object.
        site: Point of the table (m).

    Returns:
        The point in the object's frame (m).
    """
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    offset = site - pose[:2]
    return jnp.stack([c * offset[0] + s * offset[1], c * offset[1] - s * offset[0]])


def vertical_press_pose(x: float, y: float, turn: float, height: float) -> Float[np.ndarray, "4 4"]:
    """The tool's pose for a press straight down.

    Args:
        x: Of the point under the tool (m).
        y: Of the point under the tool (m).
        turn: Of the tool's x axis from the world's (rad).
        height: Of the tool over the table (m).

    Returns:
        T_w_site, its z axis down.
    """
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, s, 0, x], [s, -c, 0, y], [0, 0, -1, height], [0, 0, 0, 1]])


def node_poses(grid: PlanarGrid) -> Float[np.ndarray, "nodes 4 4"]:
    """The sites at which touches of every object are predicted.

    Args:
        grid: Of the table.

    Returns:
        T_o_site of every node; turns vary slowest, then x, then y.
    """
    at = grid.step * (np.arange(grid.across) - grid.across // 2)
    turn = 2 * np.pi * np.arange(grid.turns) / grid.turns
    poses = [vertical_press_pose(x, y, phi, grid.height) for phi in turn for x in at for y in at]
    return np.stack(poses).astype(np.float32)


def pose_cells(grid: PlanarGrid) -> tuple[Float[Array, "k 3"], Particles]:
    """The poses that an object may have: the centres of cells that tile the table.

    Args:
        grid: Of the table.

    Returns:
        Poses of the centres, and particles with the covariance of a uniform distribution over a cell.
    """
    count = int(np.ceil(2 * grid.half / grid.step))
    at = (np.arange(count) - (count - 1) / 2) * (2 * grid.half / count)
    turn = 2 * np.pi * np.arange(grid.turns) / grid.turns
    pose = np.stack(np.meshgrid(at, at, turn, indexing="ij"), -1).reshape(-1, 3)
    width = np.array([2 * grid.half / count] * 2 + [TWIST_LEVER_M * 2 * np.pi / grid.turns])
    std = np.zeros(6)
    std[[0, 1, 5]] = width / np.sqrt(12)  # of a uniform distribution
    k = len(pose)
    covariance = jnp.broadcast_to(jnp.diag(jnp.float32(std**2)), (k, 6, 6))
    return jnp.float32(pose), Particles(jnp.zeros((k, 6)), covariance, jnp.ones(k), jnp.full(k, -np.log(k)))


def nearest_node(
    grid: PlanarGrid, pose: Float[Array, "3"], site: Float[Array, "2"]
) -> tuple[Int[Array, ""], Float[Array, "6"]]:
    """The node nearest to a press.

    Args:
        grid: Of the table.
        pose: Of the object, with one of the grid's turns.
        site: Point of the table that is pressed (m).

    Returns:
        Index of the node, and the displacement of the object (m, a twist) that would bring the node to the press.
    """
    at = object_frame_pose(pose, site)
    cell = jnp.round(at / grid.step)
    i, j = cell.astype(int) + grid.across // 2
    turn = jnp.round(-pose[2] * grid.turns / (2 * jnp.pi)).astype(int) % grid.turns
    offset = cell * grid.step - at
    return (turn * grid.across + i) * grid.across + j, jnp.zeros(6).at[:2].set(offset)


def update(
    state: Belief,
    observation: TouchObservation,
    site: Float[Array, "2"],
    *,
    cells: Float[Array, "k 3"],
    predicted: PredictedTouch,
    likelihood: Likelihood,
    grid: PlanarGrid,
) -> Belief:
    """The belief after one more press.

    Args:
        state: The belief before, (objects, k).
        observation: What was measured.
        site: Point of the table that was pressed (m).
        cells: Poses that the objects may have (`pose_cells`).
        predicted: Touches at all nodes, (nodes, objects).
        likelihood: How far measurements may be from predictions.
        grid: Of the table.

    Returns:
        The belief with that press.
    """
    likelihood = likelihood._replace(inflation=grid.inflation * likelihood.inflation)
    node, offset = jax.vmap(lambda pose: nearest_node(grid, pose, site))(cells)
    rows = jax.tree.map(lambda x: jnp.swapaxes(x[node], 0, 1), predicted)
    after = belief.update(state._replace(mean=state.mean + offset[None]), observation, rows, likelihood)
    return after._replace(mean=after.mean - offset[None])


def most_probable_poses(state: Belief, cells: Float[Array, "k 3"], grid: PlanarGrid, within: float = 2.5) -> PlanarPose:
    """The most probable pose of each object.

    Args:
        state: The belief after some presses.
        cells: Poses that the objects may have.
        grid: Of the table.
        within: Distance in cells and turns from the most probable cell up to which the mean is taken.

    Returns:
        Poses of the objects, and how probable they are.
    """
    turn = 2 * jnp.pi / grid.turns

    def one(log_weight: Array, mean: Array) -> PlanarPose:
        share = jax.nn.softmax(log_weight)
        best = cells[jnp.argmax(log_weight)]
        offset = cells - best[None]
        around = _wrapped(offset[:, 2])
        near = (jnp.abs(offset[:, :2]).max(1) < within * grid.step) & (jnp.abs(around) < within * turn)
        c, s = jnp.cos(cells[:, 2]), jnp.sin(cells[:, 2])
        moved = jnp.stack([c * mean[:, 0] - s * mean[:, 1], s * mean[:, 0] + c * mean[:, 1]], -1)
        at = jnp.concatenate([offset[:, :2] + moved, (around + mean[:, 5] / TWIST_LEVER_M)[:, None]], -1)
        weight = jnp.where(near, share, 0.0)
        total = jnp.sum(weight)
        return PlanarPose(best + jnp.sum(weight[:, None] * at, 0) / total, total)

    return jax.vmap(one)(state.log_weight, state.mean)


def condition_on_pose(
    state: Belief, cells: Float[Array, "k 3"], known: Float[Array, "3"], std: Float[Array, "3"]
) -> Belief:
    """The belief if the pose were known: the cost of not knowing it.

    Args:
        state: The belief.
        cells: Poses that the objects may have.
        known: The pose.
        std: Standard deviations with which it is known (m, m, rad).

    Returns:
        The belief with the same probabilities of the objects, their particles about the pose.
    """
    offset = cells - known[None]
    offset = offset.at[:, 2].set(_wrapped(offset[:, 2]))
    log = -0.5 * jnp.sum((offset / std[None]) ** 2, axis=1)
    weight = logsumexp(state.log_weight, axis=1, keepdims=True) + (log - logsumexp(log))[None]
    return state._replace(log_weight=weight)


def _wrapped(angle: Array) -> Array:
    """The same angle (rad) between -pi and pi."""
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
