"""Four ways to tell which stamp pressed, and the ways to hold presses out.

  paper's classifier             15 readings into 500, 10 and 5 units
  paper's classifier + arm       the same, told what the arm measured too: place, turn, force and travel
  network on imagined presses    15 readings; an ensemble that besides the presses at hand has met thousands that were
                                 imagined on the skin fitted to them (`experiments.shapes.pad`), noise drawn afresh
  imagined touch                 which stamp, pressed where the arm says with the force it measured, would have read so?

The first three answer from what training presses looked like, the last from what each hypothesis would feel like. Only
the paper's classifier and the network answer from readings alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.shapes.networks import Classifier, classify
from experiments.shapes.pad import LAYERS, Imagined, Skin, Where, log_likelihood, read, remembered
from experiments.shapes.world import PREFIX, SHAPES
from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.simulation import touches as simulation
from i2t.skin.elasticity import GRID, Grid
from i2t.types import READINGS, Board, Pad, ReturnCode

PAPER, ARM, NETWORK, IMAGINED = (
    "paper's classifier", "paper's classifier + arm", "network on imagined presses", "imagined touch",
)  # fmt: skip
METHODS = (PAPER, ARM, NETWORK, IMAGINED)
SPLITS = ("random", "location", "depth", "angle")
FOLDS = 5
BLOCK = 2e-3  # m, edge of the squares of places that are never torn apart
REAL_WEIGHT = 0.5  # share of a reading's spread that training adds to a press that has its own


@dataclass(frozen=True)
class Methods:
    """Sizes of the methods."""

    paper: Classifier = field(default_factory=Classifier)
    network: Classifier = field(default_factory=lambda: Classifier(steps=4000))
    library: int = 640  # places, each imagined under every stamp
    layers: int = len(LAYERS)  # how many of `LAYERS` a skin may have
    grid: Grid = GRID  # of the fitted skin


class Presses(NamedTuple):
    """Presses on one pad, in order of time; NaN where the arm did not say."""

    reading: np.ndarray  # (n, 15) uT
    before: np.ndarray  # (n, 15) uT, the reading before it in its sitting; zero for the first
    shape: np.ndarray  # (n,)
    place: np.ndarray  # (n, 2) m
    turn: np.ndarray  # (n,) rad
    force: np.ndarray  # (n,) N
    depth: np.ndarray  # (n,) m
    run: np.ndarray  # (n,)

    @property
    def where(self) -> Where:
        """What the arm knew."""
        return Where(self.place, self.turn, self.force)

    @property
    def placed(self) -> bool:
        """Whether it knew all that a press is imagined from."""
        return all(bool(np.isfinite(leaf).all()) for leaf in self.where)


def presses_on(dataset: Dataset, pad: int, readings: np.ndarray | None = None) -> Presses:
    """The presses of one pad; `readings` (n, 15) of the whole set may take the place of its own."""
    touches = dataset.touches
    met = ~np.isin(touches.code, [ReturnCode.FAILED, ReturnCode.AIR])
    rows = np.flatnonzero((touches.pad == pad) & met)
    y = (touches.reading if readings is None else readings)[rows].astype(np.float64)
    run = touches.run[rows]
    before = np.concatenate([np.zeros((1, READINGS)), y[:-1]])
    before[np.r_[True, run[1:] != run[:-1]]] = 0
    T_t_w = np.linalg.inv(touches.T_w_t[rows].astype(np.float64))
    T_t_o = T_t_w @ touches.T_w_o[rows].astype(np.float64)
    return Presses(
        y, before, touches.object[rows], T_t_o[:, :2, 3], np.arctan2(T_t_o[:, 1, 0], T_t_o[:, 0, 0]),
        touches.force[rows].astype(np.float64), touches.depth[rows].astype(np.float64), run,
    )  # fmt: skip


def shapes_of(dataset: Dataset) -> tuple[str, ...]:
    """The names of the shapes, as the catalogue of stamps has them where it does."""
    if len(dataset.objects) < 2:
        raise DataError(f"the data set holds {len(dataset.objects)} shape; to tell shapes apart takes two at least")
    return tuple(name.removeprefix(PREFIX) for name in dataset.objects)


def folds(presses: Presses, how: str, seed: int) -> np.ndarray | None:
    """Which of `FOLDS` parts each press is tested in; None where the arm did not say what the split needs.

    random: any presses. location: squares of 2 mm. depth: fifths of each shape's travel (or force). angle: sectors of
    72 degrees.
    """
    rng = np.random.default_rng(seed)
    n = len(presses.shape)
    if how == "random":
        return rng.permutation(n) % FOLDS
    if how == "angle":
        if not np.isfinite(presses.turn).all():
            return None
        sector = np.floor((presses.turn % (2 * np.pi)) / (2 * np.pi) * FOLDS).astype(int)
        return np.minimum(sector, FOLDS - 1)
    if how == "depth":
        load = presses.depth if np.isfinite(presses.depth).all() else presses.force
        if not np.isfinite(load).all():
            return None
        part = np.zeros(n, int)
        for shape in np.unique(presses.shape):
            rows = np.flatnonzero(presses.shape == shape)
            part[rows[np.argsort(load[rows], kind="stable")]] = np.arange(len(rows)) * FOLDS // len(rows)
        return part
    if how != "location":
        raise ValueError(f"{how!r} is no split; choose one of {', '.join(SPLITS)}")
    if not np.isfinite(presses.place).all():
        return None
    cell = np.floor(presses.place / BLOCK).astype(int)
    block = np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1)
    counts = np.bincount(block)
    part, filled = np.zeros(len(counts), int), np.zeros(FOLDS)
    for i in rng.permutation(len(counts)):  # each block to the part that has least
        part[i] = np.argmin(filled)
        filled[part[i]] += counts[i]
    return part[block]


class Bench:
    """One pad's presses and what was worked out about them; its methods share the fitted skins."""

    def __init__(self, presses: Presses, board: Board, names: tuple[str, ...], cfg: Methods, seed: int) -> None:
        self.presses, self.names, self.cfg, self.seed = presses, names, cfg, seed
        known = presses.placed and set(names) <= set(SHAPES)
        self.imagined = Imagined(board, names, presses.where, presses.shape, cfg.layers, cfg.grid) if known else None
        self._kept: tuple[tuple, Skin, np.ndarray] | None = None
        rng = np.random.default_rng(seed)
        if known:
            # Other places than the presses', drawn as widely.
            low, high = presses.place.min(0), presses.place.max(0)
            n = cfg.library
            self.library = Where(
                rng.uniform(low, high, (n, 2)),
                rng.uniform(0, 2 * np.pi, n),
                rng.uniform(presses.force.min(), presses.force.max(), n),
            )

    def with_readings(self, presses: Presses) -> "Bench":
        """The same presses, read by another sensor: what was worked out of their places stays."""
        other = object.__new__(Bench)
        other.__dict__.update(self.__dict__ | {"presses": presses})
        return other

    def methods(self) -> tuple[str, ...]:
        """Those that can be had of these presses."""
        arm = (ARM,) if np.isfinite(self._arm()).all() else ()
        return (PAPER, *arm, *((NETWORK, IMAGINED) if self.imagined else ()))

    def log_p(self, method: str, train: np.ndarray, test: np.ndarray, seed: int) -> np.ndarray:
        """Log probability (up to a constant) of each shape at the presses `test`, learnt from those of `train`."""
        p, classes = self.presses, len(self.names)
        if method in (PAPER, ARM):
            x = p.reading if method == PAPER else np.c_[p.reading, self._arm()]
            return classify(seed, self.cfg.paper, x[train], p.shape[train], x[test], classes)
        assert self.imagined is not None
        skin, readings = self.fitted(train)
        if method == IMAGINED:
            phi = self.imagined.hypotheses(skin.layer, p.where, "presses")
            return log_likelihood(skin, phi[test], readings[test])
        made = read(skin, self.imagined.hypotheses(skin.layer, self.library, "library")).reshape(-1, READINGS)
        x = np.concatenate([made, readings[train]])
        y = np.concatenate([np.tile(np.arange(classes), self.cfg.library), p.shape[train]])
        share = np.concatenate([np.ones(len(made)), np.full(len(train), REAL_WEIGHT)])
        return classify(seed, self.cfg.network, x, y, readings[test], classes, share, skin.covariance)

    def guesses(self, method: str, part: np.ndarray) -> np.ndarray:
        """The shape guessed for each press when its part is held out."""
        guess = np.zeros(len(part), int)
        for fold in np.unique(part):
            train, test = np.flatnonzero(part != fold), np.flatnonzero(part == fold)
            guess[test] = self.log_p(method, train, test, self.seed + int(fold)).argmax(1)
        return guess

    def _arm(self) -> np.ndarray:
        p = self.presses
        return np.c_[p.place, np.cos(p.turn), np.sin(p.turn), p.force, p.depth]

    def fitted(self, train: np.ndarray) -> tuple[Skin, np.ndarray]:
        """The skin fitted to labelled presses, and all readings (n, 15) uT less what chips remember."""
        assert self.imagined is not None
        p, key = self.presses, (train.tobytes(), self.presses.reading.tobytes()[:64])
        if self._kept is None or self._kept[0] != key:
            first = self.imagined.fit(train, p.reading[train])
            runs = np.unique(p.run)
            kept = remembered(first.residuals, p.before[train], p.run[train], runs)
            readings = p.reading - kept[np.searchsorted(runs, p.run)] * p.before
            self._kept = (key, self.imagined.fit(train, readings[train]), readings)
        return self._kept[1], self._kept[2]


def few(presses: Presses, each: int, seed: int) -> np.ndarray:
    """Rows of `each` presses of every shape."""
    rng = np.random.default_rng(seed)
    return np.sort(
        np.concatenate([rng.permutation(np.flatnonzero(presses.shape == s))[:each] for s in np.unique(presses.shape)])
    )


def read_again(dataset: Dataset, pads: list[Pad], errors: simulation.Errors, seed: int) -> np.ndarray:
    """(n, 15): what another sensor reads of the same simulated presses, whose ideal readings are known."""
    touches = dataset.touches
    assert touches.truth is not None
    made = np.zeros_like(touches.reading)
    for run in np.unique(touches.run):
        rows = np.flatnonzero(touches.run == run)
        some = jax.tree.map(lambda leaf, rows=rows: jnp.asarray(leaf[rows]), touches)
        pad = pads[int(touches.pad[rows[0]])]
        key = jax.random.fold_in(jax.random.key(seed), int(run))
        made[rows] = _feel(key, some._replace(reading=some.truth.reading), pad, errors).reading
    return made


_feel: Callable = jax.jit(simulation.feel, static_argnames="errors")
