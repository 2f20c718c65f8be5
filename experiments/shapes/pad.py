"""A skin learnt from labelled presses of stamps, and what each stamp would read on it where the arm says it presses.

For a known stamp, place, turn and force the pressure is known up to the layer, and the reading is linear in the skin's
magnetisation: the map is fitted by Bayesian linear regression as in `i2t.calibration.physics`, which does so for round
tips. Of the numbers that are not linear only thickness and give are told apart, by how well all other presses predict
each (leave-one-out density) on a grid of layers. What one press leaves unexplained of the next, the noise, the tilt of
the stamp and what the layer cannot say, is a covariance of the residuals; a chip that remembers the press before is
found by regressing the residuals of a sitting on the readings before.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from experiments.shapes.world import Stamp, heights, pose, stamps
from i2t.calibration import physics
from i2t.calibration.physics import Layer, Tip
from i2t.skin.contact import FAR
from i2t.skin.elasticity import GRID, Grid
from i2t.types import CHIPS, PAD_WINDOW, READINGS, Board

LAYERS = [(thickness, give) for give in (1e-6, 0.25e-3) for thickness in (2.0e-3, 2.5e-3, 3.0e-3)]  # m, m/N
TOLD = 48  # presses from which the layer is chosen
NOISES = (3.0, 5.0)  # uT, of a reading, with what the layer cannot say
SPREAD = 1.0  # uT, least standard deviation of a residual
LEAST = 0.05  # N, where a noisy wrench sensor says less
MEMORY = 8.0  # presses' worth of belief that a chip remembers nothing
CHUNK = 64


@dataclass(frozen=True)
class Face(Tip):
    """A tip of any flat shape, already where it presses."""

    seen: Array | None = None  # (n, n) m behind the nearest point

    def height(self, place: Float[Array, "2"], grid: Grid = GRID) -> Float[Array, "n n"]:
        """What lies over the cells."""
        assert self.seen is not None
        return self.seen


class Where(NamedTuple):
    """What the arm knows of n presses."""

    place: Float[np.ndarray, "n 2"]  # m, of the face's middle on the skin
    turn: Float[np.ndarray, " n"]  # rad
    force: Float[np.ndarray, " n"]  # N


class Skin(NamedTuple):
    """A fitted skin."""

    layer: int  # in `LAYERS`
    weights: Float[Array, " k"]
    covariance: Float[np.ndarray, "15 15"]  # uT^2, of what is left of a reading
    residuals: Float[np.ndarray, "n 15"]  # uT, of the presses that it was fitted to, each as all others predict it


def layer(thickness: float, give: float) -> Layer:
    """A middling layer of a given thickness (m) and give (m/N)."""
    middle = physics.prior().middle._replace(thickness=jnp.float32(thickness), give=jnp.float32(give))
    return jax.tree.map(jnp.float32, middle)


@partial(jax.jit, static_argnames=("grid",))
def designs(
    under: Layer, board: Board, drawn: Stamp, which: Int[Array, " n"], where: Where, grid: Grid = GRID
) -> Float[Array, "n 15 k"]:
    """What a press of each stamp `which` reads (uT) of each weight of the map, of prior variance 1."""

    def one(args: tuple) -> Array:
        index, place, turn, force = args
        stamp = jax.tree.map(lambda leaf: leaf[index], drawn)
        met = heights(stamp, pose(place, turn, stamp), PAD_WINDOW, grid.cells)[0]
        tip = Face("cylinder", 1.0, jnp.minimum(met - jnp.min(met), FAR))
        designed = physics.design(under, board, tip, jnp.zeros(2), jnp.maximum(force, LEAST), True, grid)
        return physics.features(under, designed[None], PAD_WINDOW)[0]

    return jax.lax.map(one, (which, *where), batch_size=physics.BATCH)


class Imagined:
    """Designs of one skin's presses, each worked out when it is first asked for and kept."""

    def __init__(
        self, board: Board, names: Sequence[str], where: Where, shape: np.ndarray, layers: int, grid: Grid = GRID
    ) -> None:
        self.board, self.drawn, self.classes, self.grid = board, stamps(names), len(names), grid
        self.layers = range(layers)
        self.where, self.shape = where, shape
        self._own: dict[tuple[int, int], np.ndarray] = {}
        self._all: dict[tuple, np.ndarray] = {}

    def own(self, at: int, rows: np.ndarray) -> np.ndarray:
        """(n, 15, k) of what was pressed, on a layer of `LAYERS`."""
        missing = [row for row in rows if (at, row) not in self._own]
        if missing:
            made = self._designs(at, self.shape[missing], Where(*(leaf[missing] for leaf in self.where)))
            self._own |= {(at, row): design for row, design in zip(missing, made, strict=True)}
        return np.stack([self._own[at, row] for row in rows])

    def hypotheses(self, at: int, where: Where, name: str) -> np.ndarray:
        """(n, c, 15, k) of every stamp in turn at every place of a set that is called `name`."""
        if (at, name) not in self._all:
            n = len(where.force)
            each = Where(*(np.repeat(leaf, self.classes, axis=0) for leaf in where))
            made = self._designs(at, np.tile(np.arange(self.classes), n), each)
            self._all[at, name] = made.reshape(n, self.classes, *made.shape[1:])
        return self._all[at, name]

    def _designs(self, at: int, which: np.ndarray, where: Where) -> np.ndarray:
        under, parts = layer(*LAYERS[at]), []
        for start in range(0, len(which), CHUNK):  # of one size, and so compiled once
            rows = np.minimum(np.arange(start, start + CHUNK), len(which) - 1)
            some = Where(*(jnp.float32(leaf[rows]) for leaf in where))
            parts.append(np.asarray(designs(under, self.board, self.drawn, jnp.int32(which[rows]), some, self.grid)))
        return np.concatenate(parts)[: len(which)]

    def fit(self, rows: np.ndarray, readings: Float[np.ndarray, "n 15"]) -> Skin:
        """The skin from labelled presses `rows` and their readings (uT): the layer that best predicts each of (at most
        `TOLD` of) them from the others, and its map.
        """
        told = np.argsort(_PRIORITY[rows % len(_PRIORITY)], kind="stable")[:TOLD]  # mostly the same in all folds
        scores = [
            max(float(np.mean(_regress(self.own(at, rows[told]), readings[told], noise).density)) for noise in NOISES)
            for at in self.layers
        ]
        best = int(np.argmax(scores))
        phi = self.hypotheses(best, self.where, "presses")[rows, self.shape[rows]]
        solved = max((_regress(phi, readings, noise) for noise in NOISES), key=lambda s: float(np.mean(s.density)))
        left = np.asarray(readings - solved.mean, np.float64)
        # Shrunk towards its diagonal as by as many presses as there are values.
        raw = left.T @ left
        covariance = (raw + READINGS * np.diag(np.diag(raw)) / len(left)) / (len(left) + READINGS)
        return Skin(best, solved.weights, covariance + SPREAD**2 * np.eye(READINGS), left)


def _regress(phi: np.ndarray, readings: np.ndarray, noise: float) -> physics.Solved:
    return _compiled(jnp.asarray(phi), jnp.float32(readings), jnp.float32(noise))


_compiled = jax.jit(physics.regress)
_PRIORITY = np.random.default_rng(0).permutation(100_003)


def remembered(residuals: np.ndarray, before: np.ndarray, runs: np.ndarray, every: np.ndarray) -> np.ndarray:
    """What part (m, 15) of the press before each chip keeps in each sitting of `every` (m,): ridge regression of the
    residuals (n, 15) of presses of sittings `runs` (n,) on the readings (n, 15) `before` them.
    """
    kept = np.zeros((len(every), CHIPS))
    power = np.maximum((before**2).reshape(-1, CHIPS, 3).sum(2).mean(0), 1e-9)
    for i, run in enumerate(every):
        x, y = (values[runs == run].reshape(-1, CHIPS, 3) for values in (before, residuals))
        kept[i] = (x * y).sum((0, 2)) / ((x**2).sum((0, 2)) + MEMORY * power)
    return np.repeat(kept, 3, axis=1)


def read(skin: Skin, phi: Float[np.ndarray, "*n 15 k"]) -> np.ndarray:
    """The readings (*n, 15) uT that a skin is expected to give."""
    return np.asarray(phi @ np.asarray(skin.weights))


def log_likelihood(skin: Skin, phi: Float[np.ndarray, "n c 15 k"], readings: Float[np.ndarray, "n 15"]) -> np.ndarray:
    """(n, c): how probable the readings are if each of c stamps had been pressed there, up to a constant."""
    error = readings[:, None] - read(skin, phi)
    return -0.5 * np.einsum("nco,op,ncp->nc", error, np.linalg.inv(skin.covariance), error)
