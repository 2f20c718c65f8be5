"""The compared classifiers of stamps, and the splits by which presses are held out.

  paper's classifier             15 readings into 500, 10 and 5 units (`i2t.paper.classifier`)
  classifier with pose           the same kind of network, also given position, rotation and force, of tuned size
  imagined touch                 which stamp, pressed where the arm says with the force it measured, would have read so
                                 on the skin fitted to the presses at hand (`experiments.shapes.pad`)?

The first answers from readings alone, the others know as much of the press as each other. Minibatches are drawn with
replacement, so that trainings on different numbers of presses share one compiled program.
"""

from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from experiments.shapes.pad import (
    LAYERS,
    FittedSkin,
    StampFeatures,
    StampPoses,
    fit_hysteresis,
    log_likelihood,
)
from experiments.shapes.world import PREFIX, SHAPES
from i2t.dataset import Dataset, square_blocks
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.paper import classifier
from i2t.paper.classifier import Classifier, Layers
from i2t.skin.elasticity import GRID, Grid
from i2t.types import Board, ReturnCode

PAPER, POSED, IMAGINED = "paper's classifier", "classifier with pose", "imagined touch"
METHODS = (PAPER, POSED, IMAGINED)
CAPACITY_ROWS = 2048  # of a training set; capacities are multiples of it
SPLITS = ("random", "location", "travel", "angle")
FOLDS = 5
BLOCK_EDGE_M = 2e-3  # of the squares of positions that are never torn apart


@dataclass(frozen=True)
class Methods:
    """Sizes of the methods."""

    paper: Classifier = field(default_factory=Classifier)
    # Chosen among eight sizes, lengths and decays on random fifths, squares and 20 presses of pad 3, which is no test.
    posed: Classifier = field(default_factory=lambda: Classifier((256, 256, 256), decay=3.0))
    layers: int = len(LAYERS)  # how many of `LAYERS` a skin may have
    grid: Grid = GRID  # of the fitted skin

    def network(self, method: str) -> Classifier:
        """The network of a classifier."""
        return self.paper if method == PAPER else self.posed


class StampPresses(NamedTuple):
    """Presses on one pad, in order of time; NaN where the arm did not say."""

    reading: np.ndarray  # (n, c) uT
    before: np.ndarray  # (n, c) uT, the reading before it in its session; zero for the first
    shape: np.ndarray  # (n,)
    position: np.ndarray  # (n, 2) m
    rotation: np.ndarray  # (n,) rad, about the skin's normal
    force: np.ndarray  # (n,) N
    travel: np.ndarray  # (n,) m
    session: np.ndarray  # (n,)

    @property
    def poses(self) -> StampPoses:
        """Poses that the arm knew."""
        return StampPoses(self.position, self.rotation, self.force)

    @property
    def located(self) -> bool:
        """Tell whether the arm knew all that a press is imagined from."""
        return all(bool(np.isfinite(leaf).all()) for leaf in self.poses)

    def inputs(self, method: str) -> Float[np.ndarray, "n d"]:
        """Inputs of a classifier: readings (uT), and for `POSED` also position (m), the rotation's cosine and sine, and
        force (N).
        """
        if method == PAPER:
            return self.reading
        turn = np.stack([np.cos(self.rotation), np.sin(self.rotation)], -1)
        return np.concatenate([self.reading, self.position, turn, self.force[:, None]], -1)


def presses_on(dataset: Dataset, pad: int) -> StampPresses:
    """The presses of one pad."""
    touches = dataset.touches
    met = ~np.isin(touches.code, [ReturnCode.FAILED, ReturnCode.AIR])
    rows = np.flatnonzero((touches.pad == pad) & met)
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
    """The names of the shapes, as the catalogue of stamps has them where it does."""
    if len(dataset.objects) < 2:
        raise DataError(f"the data set holds {len(dataset.objects)} shape; to tell shapes apart takes two at least")
    return tuple(name.removeprefix(PREFIX) for name in dataset.objects)


def split_folds(presses: StampPresses, split: str, seed: int) -> np.ndarray | None:
    """The one of `FOLDS` parts that each press is tested in; None where the arm did not say what the split needs.

    random: any presses. location: squares of 2 mm. travel: fifths of each shape's travel (or force). angle: sectors of
    72 degrees.
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
    block = square_blocks(presses.position, BLOCK_EDGE_M, origin=(0.0, 0.0))
    counts = np.bincount(block)
    part, filled = np.zeros(len(counts), int), np.zeros(FOLDS)
    for i in rng.permutation(len(counts)):  # each block to the part that has least
        part[i] = np.argmin(filled)
        filled[part[i]] += counts[i]
    return part[block]


@dataclass(frozen=True)
class StampClassificationBenchmark:
    """One pad's presses and what was worked out about them.

    Attributes:
        presses: In the order of time.
        board: The sensor board.
        names: Of the shapes.
        cfg: Sizes of the methods.
        seed: Of the classifiers.
    """

    presses: StampPresses
    board: Board
    names: tuple[str, ...]
    cfg: Methods
    seed: int

    @cached_property
    def features(self) -> StampFeatures | None:
        """What presses are imagined from, where the arm said where they were and the stamps are the catalogue's."""
        if not (self.presses.located and set(self.names) <= set(SHAPES)):
            return None
        where, cfg = self.presses, self.cfg
        return StampFeatures(self.board, self.names, where.poses, where.shape, layers=cfg.layers, grid=cfg.grid)

    def methods(self) -> tuple[str, ...]:
        """Names of the methods that these presses allow."""
        networks = (PAPER, POSED) if self.presses.located else (PAPER,)
        return METHODS if self.features else networks

    def log_probability(self, method: str, train: np.ndarray, test: np.ndarray, seed: int) -> np.ndarray:
        """Log probability (up to a constant) of each shape at the presses `test`, from those of `train`."""
        p, classes = self.presses, len(self.names)
        if method in (PAPER, POSED):
            x = p.inputs(method)
            return classify(self.cfg.network(method), x[train], p.shape[train], x[test], classes=classes, seed=seed)
        assert self.features is not None
        skin, readings = self.fitted(train)
        return log_likelihood(skin, self.features.hypotheses(skin.layer)[test], readings[test])

    def guesses(self, method: str, part: np.ndarray) -> np.ndarray:
        """The shape guessed for each press when its part is held out."""
        guess = np.zeros(len(part), int)
        for fold in np.unique(part):
            train, test = np.flatnonzero(part != fold), np.flatnonzero(part == fold)
            guess[test] = self.log_probability(method, train, test, self.seed + int(fold)).argmax(1)
        return guess

    def fitted(self, train: np.ndarray) -> tuple[FittedSkin, np.ndarray]:
        """The skin fitted to labelled presses, and all readings (n, c) uT less the chips' hysteresis."""
        assert self.features is not None
        p = self.presses
        first = self.features.fit(train, p.reading[train])
        sessions = np.unique(p.session)
        kept = fit_hysteresis(first.residuals, p.before[train], p.session[train], sessions)
        readings = p.reading - kept[np.searchsorted(sessions, p.session)] * p.before
        return self.features.fit(train, readings[train]), readings


def rows_per_shape(presses: StampPresses, each: int, seed: int) -> np.ndarray:
    """Rows of `each` presses of every shape."""
    rng = np.random.default_rng(seed)
    return np.sort(
        np.concatenate([rng.permutation(np.flatnonzero(presses.shape == s))[:each] for s in np.unique(presses.shape)])
    )


class TrainingSet(NamedTuple):
    """Standardised inputs and their classes, padded to a capacity."""

    x: Float[Array, "rows d"]
    y: Int[Array, " rows"]
    n: Int[Array, ""]  # rows that count, the first


def classify(
    cfg: Classifier,
    x: Float[np.ndarray, "n d"],
    y: Int[np.ndarray, " n"],
    at: Float[np.ndarray, "m d"],
    *,
    classes: int,
    seed: int,
) -> Float[np.ndarray, "m classes"]:
    """Train on inputs x of classes y, and give log probabilities at other inputs.

    Args:
        cfg: How to train.
        x: Inputs.
        y: Their classes.
        at: Inputs to classify.
        classes: Number of classes.
        seed: Of the training.

    Returns:
        Log probabilities, the mean over the ensemble's members.
    """
    n, d = x.shape
    mean, std = x.mean(0), x.std(0)
    std = np.where(std > 0, std, 1)
    capacity = -(-n // CAPACITY_ROWS) * CAPACITY_ROWS
    rows, labels = np.zeros((capacity, d)), np.zeros(capacity, np.int32)
    rows[:n], labels[:n] = (x - mean) / std, y
    known = TrainingSet(jnp.float32(rows), jnp.asarray(labels), jnp.int32(n))
    keys = [jax.random.fold_in(jax.random.key(seed), i) for i in range(cfg.members)]
    log_p = [_log_probability(_train(key, known, cfg, classes), jnp.float32((at - mean) / std)) for key in keys]
    mean_p = np.asarray(jax.nn.logsumexp(jnp.stack(log_p), axis=0) - np.log(cfg.members))
    if not np.isfinite(mean_p).all():
        raise ValueError(
            "the classifier's training gave no finite probabilities; look for readings that are not finite"
        )
    return mean_p


@partial(jax.jit, static_argnames=("cfg", "classes"))
def _train(key: Key[Array, ""], known: TrainingSet, cfg: Classifier, classes: int) -> Layers:
    def draw(key: Key[Array, ""]) -> tuple[Array, Array]:
        key_rows, _ = jax.random.split(key)  # one more than is used: the draws of a seed stay
        rows = jax.random.randint(key_rows, (cfg.batch,), 0, known.n)
        return known.x[rows], known.y[rows]

    return classifier.fit(key, draw, cfg, inputs=known.x.shape[1], classes=classes)


@jax.jit
def _log_probability(layers: Layers, x: Float[Array, "n d"]) -> Float[Array, "n classes"]:
    return jax.nn.log_softmax(classifier.logits(layers, x))
