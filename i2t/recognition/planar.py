"""Objects that stand anywhere on a table, turned in any way: a posterior over object and planar pose.

A press straight down at a point of the table meets an object at some place of the object's own frame, seen from some
direction. So what every object would feel like is imagined once for a grid of places and turns in its own frame
(`nodes`), and serves every press on it wherever it stands. Poses are cells of a grid over the table with the same
turns (`places`): a pose and a press lead to a node and to how far beside it the press is (`between`). The rest is
`i2t.recognition.belief`: each cell carries a normal distribution of what the pose is still off by, and the offset from
the node is one more such displacement, which the slope of the travel accounts for.

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
from i2t.recognition.belief import Belief, Likelihood, Measured, Particles
from i2t.recognition.outcomes import Outcome
from i2t.types import TWIST_LEVER_M


@dataclass(frozen=True)
class Table:
    """Where objects may stand and presses go, and how finely both are told apart."""

    half: float = 20e-3  # m: objects stand within a square of +-half about the origin
    reach: float = 25e-3  # m: presses go to points at most so far from the origin
    step: float = 2.5e-3  # m
    turns: int = 48  # directions in a full turn
    height: float = 30e-3  # m over the table, of the sites of presses
    inflation: float = 1.7  # of readings' errors, as readings are those of the nearest node; of validation objects

    @property
    def extent(self) -> float:
        """How far (m) from an object's origin a press may be."""
        return self.reach + np.sqrt(2) * self.half

    @property
    def across(self) -> int:
        """Nodes along an axis of an object."""
        return 2 * int(np.ceil(self.extent / self.step)) + 1


def seen_from(pose: Float[Array, "3"], site: Float[Array, "2"]) -> Float[Array, "2"]:
    """A point of the table in the frame of an object in a pose."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    apart = site - pose[:2]
    return jnp.stack([c * apart[0] + s * apart[1], c * apart[1] - s * apart[0]])


def straight_down(x: float, y: float, turn: float, height: float) -> Float[np.ndarray, "4 4"]:
    """The tool over (x, y), its z axis down, its x axis turned from the world's."""
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, s, 0, x], [s, -c, 0, y], [0, 0, -1, height], [0, 0, 0, 1]])


def nodes(table: Table) -> Float[np.ndarray, "nodes 4 4"]:
    """Sites T_o_site in an object's frame; turns vary slowest, then x, then y."""
    at = table.step * (np.arange(table.across) - table.across // 2)
    turn = 2 * np.pi * np.arange(table.turns) / table.turns
    made = [straight_down(x, y, phi, table.height) for phi in turn for x in at for y in at]
    return np.stack(made).astype(np.float32)


def places(table: Table) -> tuple[Float[np.ndarray, "k 3"], Particles]:
    """Poses in the middle of cells that tile the table, and how far off each may be."""
    count = int(np.ceil(2 * table.half / table.step))
    at = (np.arange(count) - (count - 1) / 2) * (2 * table.half / count)
    turn = 2 * np.pi * np.arange(table.turns) / table.turns
    pose = np.stack(np.meshgrid(at, at, turn, indexing="ij"), -1).reshape(-1, 3)
    width = np.array([2 * table.half / count] * 2 + [TWIST_LEVER_M * 2 * np.pi / table.turns])
    spread = np.zeros(6)
    spread[[0, 1, 5]] = width / np.sqrt(12)  # of a uniform distribution
    return pose.astype(np.float32), Particles(jnp.zeros((len(pose), 6)), jnp.diag(jnp.float32(spread**2)))


def between(table: Table, pose: Float[Array, "3"], site: Float[Array, "2"]) -> tuple[Int[Array, ""], Float[Array, "6"]]:
    """The node nearest to a press at a point of the table on an object in a pose that has one of the table's turns,
    and the displacement of the object (m, a twist) that would bring the node to the press.
    """
    at = seen_from(pose, site)
    cell = jnp.round(at / table.step)
    i, j = cell.astype(int) + table.across // 2
    turn = jnp.round(-pose[2] * table.turns / (2 * jnp.pi)).astype(int) % table.turns
    beside = cell * table.step - at
    return (turn * table.across + i) * table.across + j, jnp.zeros(6).at[:2].set(beside)


def update(
    now: Belief,
    measured: Measured,
    site: Float[Array, "2"],
    pose: Float[Array, "k 3"],
    imagined: Outcome,
    like: Likelihood,
    table: Table,
) -> Belief:
    """The belief (objects, k) after a press at a point of the table; `imagined` is (nodes, objects)."""
    like = like._replace(inflation=table.inflation * like.inflation)
    node, beside = jax.vmap(lambda at: between(table, at, site))(pose)
    rows = jax.tree.map(lambda x: jnp.swapaxes(x[node], 0, 1), imagined)
    after = belief.update(now._replace(mean=now.mean + beside[None]), measured, rows, like)
    return after._replace(mean=after.mean - beside[None])


class Standing(NamedTuple):
    """Where an object stands, if it is the one."""

    pose: Float[Array, "3"]  # x, y, turn of the most probable cell and what belongs to it
    share: Float[Array, ""]  # probability of that


def standing(now: Belief, pose: Float[Array, "k 3"], table: Table, within: float = 2.5) -> Standing:
    """Most probable pose of each object (objects,): the mean of what is believed within so many cells of the best."""
    turn = 2 * jnp.pi / table.turns

    def one(log_weight: Array, mean: Array) -> Standing:
        share = jax.nn.softmax(log_weight)
        best = pose[jnp.argmax(log_weight)]
        off = pose - best[None]
        around = (off[:, 2] + jnp.pi) % (2 * jnp.pi) - jnp.pi
        near = (jnp.abs(off[:, :2]).max(1) < within * table.step) & (jnp.abs(around) < within * turn)
        c, s = jnp.cos(pose[:, 2]), jnp.sin(pose[:, 2])
        moved = jnp.stack([c * mean[:, 0] - s * mean[:, 1], s * mean[:, 0] + c * mean[:, 1]], -1)
        at = jnp.concatenate([off[:, :2] + moved, (around + mean[:, 5] / TWIST_LEVER_M)[:, None]], -1)
        weight = jnp.where(near, share, 0.0)
        total = jnp.sum(weight)
        return Standing(best + jnp.sum(weight[:, None] * at, 0) / total, total)

    return jax.vmap(one)(now.log_weight, now.mean)


def about(now: Belief, pose: Float[Array, "k 3"], known: Float[Array, "3"], spread: Float[Array, "3"]) -> Belief:
    """The belief if the pose were known up to a `spread` (m, m, rad): what not knowing it costs."""
    off = pose - known[None]
    off = off.at[:, 2].set((off[:, 2] + jnp.pi) % (2 * jnp.pi) - jnp.pi)
    log = -0.5 * jnp.sum((off / spread[None]) ** 2, axis=1)
    weight = logsumexp(now.log_weight, axis=1, keepdims=True) + (log - logsumexp(log))[None]
    return now._replace(log_weight=weight)
