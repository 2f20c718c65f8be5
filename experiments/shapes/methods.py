"""The compared classifiers of stamps, and the splits by which presses are held out.

  paper's classifier             15 readings, then layers of 500, 10 and 5 units (`i2t.paper.classifier`)
  classifier with pose           a network of the same kind and tuned size, with position, rotation and force as inputs
  predicted touch                the stamp whose predicted reading, on a skin fitted to the training presses, is most
                                 likely at the measured pose and force (`experiments.shapes.pad`)

The first uses readings only, and the other two have the same additional inputs. Minibatches are drawn with replacement,
so that training on different numbers of presses shares one compiled program.
"""

from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from experiments.shapes.pad import LAYERS, FittedSkin, StampFeatures, StampPoses, fit_hysteresis, log_likelihood
from experiments.shapes.world import PREFIX, SHAPES
from i2t.dataset import Dataset, square_blocks
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.paper import classifier
from i2t.paper.classifier import Classifier, Layers
from i2t.skin.elasticity import GRID, Grid
from i2t.types import Board, ReturnCode

PAPER, POSED, PREDICTED = "paper's classifier", "classifier with pose", "predicted touch"
METHODS = (PAPER, POSED, PREDICTED)
SPLITS = ("random", "location", "travel", "angle")
FOLDS = 5


@dataclass(frozen=True)
class Methods:
    """Settings of the methods."""

    paper: Classifier = field(default_factory=Classifier)
    # Chosen among eight sizes, lengths and decays on random fifths, squares and 20 presses of pad 3, which is not a
    # test pad.
    posed: Classifier = field(default_factory=lambda: Classifier((256, 256, 256), decay=3.0))
    layers: int = len(LAYERS)  # number of `LAYERS` that are tried for a skin
    grid: Grid = GRID  # of the fitted skin

    def network(self, method: str) -> Classifier:
        """Select the network of a classifier."""
        return self.paper if method == PAPER else self.posed


class StampPresses(NamedTuple):
    """Presses on one pad in chronological order, with NaN for quantities that were not measured."""

    reading: np.ndarray  # (n, c) uT
    before: np.ndarray  # (n, c) uT, the previous reading in the session; zero for the first
    shape: np.ndarray  # (n,)
    position: np.ndarray  # (n, 2) m
    rotation: np.ndarray  # (n,) rad, about the skin's normal
    force: np.ndarray  # (n,) N
    travel: np.ndarray  # (n,) m
    session: np.ndarray  # (n,)

    @property
    def poses(self) -> StampPoses:
        """Measured poses and forces."""
        return StampPoses(self.position, self.rotation, self.force)

    @property
    def located(self) -> bool:
        """Whether all poses and forces were measured."""
        return all(bool(np.isfinite(leaf).all()) for leaf in self.poses)

    def inputs(self, method: str) -> Float[np.ndarray, "n d"]:
        """Collect the inputs of a classifier: readings (uT), and for `POSED` also position (m), the rotation's cosine
        and sine, and force (N).
        """
        if method == PAPER:
            return self.reading
        turn = np.stack([np.cos(self.rotation), np.sin(self.rotation)], -1)
        return np.concatenate([self.reading, self.position, turn, self.force[:, None]], -1)


def presses_on(dataset: Dataset, pad: int) -> StampPresses:
    """Select the presses on one pad."""
    touches = dataset.touches
    contact = ~np.isin(touches.code, [ReturnCode.FAILED, ReturnCode.AIR])
    rows = np.flatnonzero((touches.pad == pad) & contact)
    y = touches.reading[rows].astype(np.float64)
    session = touches.session[rows]
    before = np.concatenate([np.zeros((1, y.shape[1])), y[:-1]])
    before[np.r_[True, session[1:] != session[:-1]]] = 0
    T_t_w = inverse(touches.T_w_t[rows].astype(np.float64))
    T_t_o = T_t_w @ touches.T_w_o[rows].astype(np.float64)
    return StampPresses(
        y, before, touches.object[rows], T_t_o[:, :2, 3], np.arctan2(T_t_o[:, 1, 0], T_t_o[:, 0, 0]),
        touches.force[rows].astype(np.float64), touches.travel[rows].astype(np.float64), session,
    )  # fmt: skip


def shapes_of(dataset: Dataset) -> tuple[str, ...]:
    """List the names of the shapes, without the prefix of the catalogue's stamps."""
    if len(dataset.objects) < 2:
        raise DataError(f"the data set holds {len(dataset.objects)} shape; classification needs at least two")
    return tuple(name.removeprefix(PREFIX) for name in dataset.objects)


def split_folds(presses: StampPresses, split: str, seed: int, *, block_edge: float = 2e-3) -> np.ndarray | None:
    """Assign each press to one of `FOLDS` test parts; None if the quantity of the split was not measured.

    random: any presses. location: squares of `block_edge` (m). travel: fifths of each shape's travel (or force). angle:
    sectors of 72 degrees.
    """
    rng = np.random.default_rng(seed)
    n = len(presses.shape)
    if split == "random":
        return rng.permutation(n) % FOLDS
    if split == "angle":
        if not np.isfinite(presses.rotation).all():
            return None
        sector = np.floor((presses.rotation % (2 * np.pi)) / (2 * np.pi) * FOLDS).astype(int)
        return np.minimum(sector, FOLDS - 1)
    if split == "travel":
        load = presses.travel if np.isfinite(presses.travel).all() else presses.force
        if not np.isfinite(load).all():
            return None
        part = np.zeros(n, int)
        for shape in np.unique(presses.shape):
            rows = np.flatnonzero(presses.shape == shape)
            part[rows[np.argsort(load[rows], kind="stable")]] = np.arange(len(rows)) * FOLDS // len(rows)
        return part
    if not np.isfinite(presses.position).all():
        return None
    block = square_blocks(presses.position, block_edge, origin=(0.0, 0.0))
    counts = np.bincount(block)
    part, filled = np.zeros(len(counts), int), np.zeros(FOLDS)
    for i in rng.permutation(len(counts)):  # each block joins the part with the fewest presses
        part[i] = np.argmin(filled)
        filled[part[i]] += counts[i]
    return part[block]


@dataclass(frozen=True)
class StampClassificationBenchmark:
    """Classification of one pad's presses by all methods.

    Attributes:
        presses: Presses in chronological order.
        board: The sensor board.
        names: Names of the shapes.
        cfg: Settings of the methods.
        seed: Seed of the classifiers.
    """

    presses: StampPresses
    board: Board
    names: tuple[str, ...]
    cfg: Methods
    seed: int

    @cached_property
    def features(self) -> StampFeatures | None:
        """Features for predicted readings, if poses were measured and the stamps are in the catalogue."""
        if not (self.presses.located and set(self.names) <= set(SHAPES)):
            return None
        presses, cfg = self.presses, self.cfg
        return StampFeatures(self.board, self.names, presses.poses, presses.shape, layers=cfg.layers, grid=cfg.grid)

    def methods(self) -> tuple[str, ...]:
        """List the methods that these presses allow."""
        networks = (PAPER, POSED) if self.presses.located else (PAPER,)
        return METHODS if self.features else networks

    def log_probability(self, method: str, train: np.ndarray, test: np.ndarray, seed: int) -> np.ndarray:
        """Compute log probabilities of the shapes, up to a constant, for rows `test` after training on rows `train`."""
        p, classes = self.presses, len(self.names)
        if method in (PAPER, POSED):
            x = p.inputs(method)
            return classify(self.cfg.network(method), x[train], p.shape[train], x[test], classes=classes, seed=seed)
        assert self.features is not None
        skin, readings = self.fitted(train)
        return log_likelihood(skin, self.features.hypotheses(skin.layer)[test], readings[test])

    def guesses(self, method: str, part: np.ndarray) -> np.ndarray:
        """Classify each press by a method that was trained on the other parts."""
        guess = np.zeros(len(part), int)
        for fold in np.unique(part):
            train, test = np.flatnonzero(part != fold), np.flatnonzero(part == fold)
            guess[test] = self.log_probability(method, train, test, self.seed + int(fold)).argmax(1)
        return guess

    def fitted(self, train: np.ndarray) -> tuple[FittedSkin, np.ndarray]:
        """Fit the skin to labelled presses; also returns all readings (n, c) uT without the chips' hysteresis."""
        assert self.features is not None
        p = self.presses
        first = self.features.fit(train, p.reading[train])
        sessions = np.unique(p.session)
        kept = fit_hysteresis(first.residuals, p.before[train], p.session[train], sessions)
        readings = p.reading - kept[np.searchsorted(sessions, p.session)] * p.before
        return self.features.fit(train, readings[train]), readings


def rows_per_shape(presses: StampPresses, each: int, seed: int) -> np.ndarray:
    """Draw `each` presses of every shape; returns their rows."""
    rng = np.random.default_rng(seed)
    return np.sort(
        np.concatenate([rng.permutation(np.flatnonzero(presses.shape == s))[:each] for s in np.unique(presses.shape)])
    )


class TrainingSet(NamedTuple):
    """Standardised inputs and their classes, padded to a capacity."""

    x: Float[Array, "rows d"]
    y: Int[Array, " rows"]
    n: Int[Array, ""]  # number of rows without padding


def classify(
    cfg: Classifier,
    x: Float[np.ndarray, "n d"],
    y: Int[np.ndarray, " n"],
    at: Float[np.ndarray, "m d"],
    *,
    classes: int,
    seed: int,
    capacity_step: int = 2048,
) -> Float[np.ndarray, "m classes"]:
    """Train a classifier, and predict log probabilities of the classes.

    Args:
        cfg: Settings of the network and its training.
        x: Training inputs, `(n, d)`.
        y: Classes of the training inputs, `(n,)`.
        at: Inputs to classify, `(m, d)`.
        classes: Number of classes.
        seed: Seed of the training.
        capacity_step: Training sets are padded to multiples of this number of rows.

    Returns:
        Log probabilities `(m, classes)` of the mean over the ensemble's members.

    Raises:
        ValueError: The probabilities are not finite.
    """
    n, d = x.shape
    mean, std = x.mean(0), x.std(0)
    std = np.where(std > 0, std, 1)
    capacity = -(-n // capacity_step) * capacity_step
    rows, labels = np.zeros((capacity, d)), np.zeros(capacity, np.int32)
    rows[:n], labels[:n] = (x - mean) / std, y
    train = TrainingSet(jnp.float32(rows), jnp.asarray(labels), jnp.int32(n))
    keys = [jax.random.fold_in(jax.random.key(seed), i) for i in range(cfg.members)]
    log_p = [_log_probability(_train(key, train, cfg, classes), jnp.float32((at - mean) / std)) for key in keys]
    mean_p = np.asarray(jax.nn.logsumexp(jnp.stack(log_p), axis=0) - np.log(cfg.members))
    if not np.isfinite(mean_p).all():
        raise ValueError(
            "the classifier's training gave no finite probabilities; look for readings that are not finite"
        )
    return mean_p


@partial(jax.jit, static_argnames=("cfg", "classes"))
def _train(key: Key[Array, ""], train: TrainingSet, cfg: Classifier, classes: int) -> Layers:
    def draw(key: Key[Array, ""]) -> tuple[Array, Array]:
        key_rows, _ = jax.random.split(key)  # keeps the random numbers of a seed
        rows = jax.random.randint(key_rows, (cfg.batch,), 0, train.n)
        return train.x[rows], train.y[rows]

    return classifier.fit(key, draw, cfg, inputs=train.x.shape[1], classes=classes)


@jax.jit
def _log_probability(layers: Layers, x: Float[Array, "n d"]) -> Float[Array, "n classes"]:
    return jax.nn.log_softmax(classifier.logits(layers, x))
