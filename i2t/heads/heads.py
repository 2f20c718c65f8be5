"""Heads: contact estimates from a skin's readings, position, depth, normal force and shear, with their spread.

    from i2t.heads.heads import fit_head
    from i2t.recordings.read import read_recordings

    (recording,) = read_recordings("my_presses.csv")
    head = fit_head(recording, "position")
    predicted = head.predict(readings)                     # (n, c) uT
    predicted.mean, predicted.std, predicted.unfamiliar    # (n, 2) m, (n, 2) m, (n,)
    head.save("position.npz")

A head is one of the methods of `regression`, or a weighted sum of them (stacked regression; Breiman, Machine Learning
24, 1996): what has the least error on whole blocks of the skin and on single presses that it was not fitted to; in a
stream, or where one position is known only, on whole strokes or stretches of time. The mean, a linear map and the k
nearest readings are among the methods, so that nothing is kept that loses to them there. What is best where presses
come back to known places (single presses left out) need not be best elsewhere (blocks left out). Where two methods are
better than one, a head keeps both, and goes from one to the other with a reading's distance from the known ones.

Spread: the errors on the same blocks say how far off the head is for a reading of this length, this near to what it
knows. A factor brings nine in ten readings of nine in ten blocks or strokes into the 90 % range: rows of one stroke err
alike, so strokes are what is exchangeable, not rows (cross-conformal prediction; Vovk, Annals of Mathematics and
Artificial Intelligence 74, 2015; of groups, Dunn, Wasserman and Ramdas, J. Am. Stat. Assoc. 118, 2023). Of fewer than
nine strokes it is that of the worst. A reading that lies farther from all known ones than these do from each other is
`unfamiliar`: a skin that changed, another tip, or a magnet near by.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from i2t.dataset import square_blocks
from i2t.files import serialization
from i2t.heads.regression import (
    HEAD_METHODS,
    MEAN_TARGET,
    FeatureMap,
    HeadBudget,
    Regression,
    Settings,
    choose_settings,
    cross_predict,
    fit_regression,
    make_feature_map,
    nearest_known,
    predict_regression,
)
from i2t.leave_one_out import STDS_WITHIN_90
from i2t.recordings.diagnose.smooth import subsample
from i2t.recordings.read import (
    TARGETS,
    SkinRecording,
    is_stream,
)

FILE_KIND_OF_HEAD = "i2t head"
HEAD_TARGETS = tuple(name for name, kind in TARGETS.items() if not kind.yes_no)
STACKED_METHODS = "weighted methods"
MIN_WEIGHT = 0.02  # of a method in a sum
FOLD_COUNT = 5
MIN_HEAD_ROWS = 20  # of a head: fewer leave nothing to choose and to test on
MIN_BLOCKS = 5  # of the skin, that blocks are held out of
BLOCK_M = 6e-3
BLOCKS_ACROSS = 4  # of a range too small for blocks of BLOCK_M
TIME_STRETCHES = 10  # of a recording of one position
RANGE_SHARE = 0.9  # of rows in a stated range, and of groups that hold as many
ALIKE_SHARE = 0.05  # of the rows, whose errors say how far off the head is for a reading like them
ALIKE_ROWS = 30  # at least
UNFAMILIAR_QUANTILE = 0.999  # of distances between known readings
UNFAMILIAR_FACTOR = 2.0
# Shares of single presses, and of blocks, whose distances from known readings end what is near and begin what is far.
GATES = ((0.5, 0.5), (0.9, 0.5), (0.9, 0.1))
FEATURES_OF_SPREAD = 0  # index into FEATURE_KINDS
STREAM_HISTORY = 3  # rows before a reading that a head of a stream may look at: what a skin remembers, how it moves


class HeadPrediction(NamedTuple):
    """Predictions of a head."""

    mean: Float[np.ndarray, "n d"]  # in the library's unit; NaN where a reading is not finite
    std: Float[np.ndarray, "n d"]  # likewise
    unfamiliar: Bool[np.ndarray, " n"]  # far from every reading that the head knows


class SpreadRecord(NamedTuple):
    """Errors on rows that were held out in several ways, and features of their readings."""

    features: FeatureMap
    known: Float[np.ndarray, "m k"]  # features of known readings
    likeness: Float[np.ndarray, "m 2"]  # log length and log distance from the others, standardised
    middle: Float[np.ndarray, " 2"]
    width: Float[np.ndarray, " 2"]
    square: Float[np.ndarray, "m d"]  # errors
    factor: Float[np.ndarray, " d"]  # on the standard deviation
    far: Float[np.ndarray, ""]  # distance from which a reading is unfamiliar


class StackRecord(NamedTuple):
    """A weighted sum of methods about the mean, m + sum w_i (f_i - m); None for a method without weight."""

    centre: Float[np.ndarray, " d"]  # m, of the targets
    weights: Float[np.ndarray, " methods"]  # in the order of HEAD_METHODS
    histories: Int[np.ndarray, " methods"]  # rows before a reading that each looks at
    mean: Regression | None = None
    linear: Regression | None = None
    nearest: Regression | None = None
    gaussian_process: Regression | None = None

    @property
    def parts(self) -> dict[str, Regression]:
        """Methods that have a weight."""
        every = (self.mean, self.linear, self.nearest, self.gaussian_process)
        return {name: part for name, part in zip(HEAD_METHODS, every, strict=True) if part is not None}


class HeadRecord(NamedTuple):
    """Head on disk."""

    stack: StackRecord
    spread: SpreadRecord
    values: Int[np.ndarray, ""]  # of a reading of the skin
    channels: Int[np.ndarray, " used"]  # of a reading, that the head looks at
    history: Int[np.ndarray, ""]  # rows before a reading that any of it looks at
    near_stack: StackRecord | None = None  # for readings that are near to known ones, where it is another
    gate: Float[np.ndarray, " 2"] | None = None  # distances up to which it is that one, and from which it is `stack`


@dataclass(frozen=True)
class Head:
    """Predicts one target from readings; make one with `fit_head` or `load_head`.

    Attributes:
        target: its name in `HEAD_TARGETS`.
        record: arrays of it.
        validation: error of each method on held-out blocks of the recording, by which this one was chosen: root mean
            square in the library's unit.
        metadata: whatever the caller wants to remember, as JSON can hold it.
    """

    target: str
    record: HeadRecord
    validation: dict[str, float] = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)

    @property
    def method(self) -> str:
        """Name of the method, or of a weighted sum of several; two names where another is used near known readings."""
        near, far = self.record.near_stack, _name_of(self.record.stack.parts)
        return far if near is None else f"{_name_of(near.parts)} near, {far} far"

    def predict(
        self, readings: Float[np.ndarray, "n c"], session: Int[np.ndarray, " n"] | None = None
    ) -> HeadPrediction:
        """Predict the target of readings.

        Args:
            readings: uT, all channels of the skin, in the order of time if the head looks back.
            session: number of the stroke or session that each follows others in; by default one.

        Returns:
            Mean and spread.

        Raises:
            ValueError: the readings are not of the skin that the head was fitted to.
        """
        readings, record = np.asarray(readings, np.float64), self.record
        if readings.ndim != 2 or readings.shape[1] != record.values:
            raise ValueError(f"readings {readings.shape} are not of the {record.values} channels that the head knows")
        session = np.zeros(len(readings), int) if session is None else np.asarray(session)
        looked = _with_history(readings[:, record.channels], session, int(record.history))
        good, d = np.isfinite(looked).all(1), len(record.stack.centre)
        mean, std = np.full((len(readings), d), np.nan), np.full((len(readings), d), np.nan)
        unfamiliar = np.ones(len(readings), bool)
        if good.any():
            now = looked[good][:, : len(record.channels)]
            distance = nearest_known(record.spread.known, record.spread.features(now), 1)[0][:, 0]
            mean[good] = _predict_stack(record.stack, looked[good], int(record.history))
            if record.near_stack is not None:
                assert record.gate is not None
                near = _predict_stack(record.near_stack, looked[good], int(record.history))
                mean[good] = _gated(record.gate, distance, near, mean[good])
            std[good], unfamiliar[good] = _spread(record.spread, now, distance), distance > record.spread.far
        return HeadPrediction(mean, std, unfamiliar)

    def save(self, path: Path | str) -> None:
        """Write one file, which appears whole or not at all.

        Args:
            path: file to write; `.npz` by custom.

        Raises:
            SerializationError: it cannot be written.
        """
        about = {"target": self.target, "validation": self.validation, "about": self.metadata}
        serialization.save(path, FILE_KIND_OF_HEAD, self.record, about)


def load_head(path: Path | str) -> Head:
    """Load a head from its file.

    Args:
        path: a file that `Head.save` wrote.

    Returns:
        The head.

    Raises:
        SerializationError: the file is missing, damaged or something else.
    """
    record, about = serialization.load(path, FILE_KIND_OF_HEAD, HeadRecord)
    with serialization.fitting(path):
        if about.get("target") not in HEAD_TARGETS:
            raise serialization.SerializationError(f"{path}: tells no target that this i2t knows; fit it again")
        return Head(about["target"], record, about["validation"], about["about"])


def fit_head(
    recording: SkinRecording,
    target: str,
    *,
    methods: Sequence[str] = HEAD_METHODS,
    history: int | None = None,
    budget: HeadBudget | None = None,
    seed: int = 0,
    metadata: dict[str, Any] | None = None,
) -> Head:
    """Fit a head to a recording, with the method that is best on blocks of it that are held out.

    Args:
        recording: of one skin.
        target: name in `HEAD_TARGETS`.
        methods: of `HEAD_METHODS` that are tried; the mean always is.
        history: how many rows before a reading the head looks at too; by default none, and in a stream what is best.
        budget: how much is tried.
        seed: of the folds.
        metadata: whatever shall be saved with it, as JSON can hold it.

    Returns:
        The head.

    Raises:
        ValueError: the recording does not know the target, or does not say enough of it; one sentence.
    """
    budget = HeadBudget() if budget is None else budget
    rows = target_rows(recording, target)
    rows = rows[subsample(len(rows), budget.rows)]
    channels = np.flatnonzero(np.ptp(recording.readings[rows], axis=0) > 0)
    if not len(channels):
        raise ValueError(f"{recording.name}: no channel changes, so that {target} cannot be predicted from them")
    values = recording.targets[target][rows]
    groups = _ways_of_grouping(recording.rows(rows))
    folds = np.stack([_fold_numbers(of, seed) for of in groups])
    tried = [MEAN_TARGET, *(name for name in methods if name != MEAN_TARGET)]
    tried_histories = ((0, STREAM_HISTORY) if is_stream(recording) else (0,)) if history is None else (history,)
    looked = {n: _with_history(recording.readings[:, channels], recording.session, n)[rows] for n in tried_histories}
    # Settings that are best in each way of holding out.
    ways = [slice(way, way + 1) for way in range(len(folds))]
    trials = _Trials(looked, values, folds, budget)
    sets = [{name: trials.best(name, way) for name in tried} for way in ways]
    readings = recording.readings[rows][:, channels]
    distance = _fold_distances(readings, folds)
    best = _choose(sets, ways, trials, distance)
    used = [best, *([best.near] if best.near else [])]
    stack, *near_stack = (_fit_stack(one, trials) for one in used)
    record = HeadRecord(
        stack=stack,
        spread=_fit_spread(readings, best.trial.predicted - values, groups, distance),
        values=np.array(recording.readings.shape[1]),
        channels=channels,
        history=np.array(max(part.histories.max() for part in (stack, *near_stack))),
        near_stack=near_stack[0] if near_stack else None,
        gate=best.gate,
    )
    validation = {name: min(found[name].error for found in sets) for name in tried}
    head = Head(target, record, validation, metadata or {})
    validation.setdefault(head.method, best.trial.error)
    return head


def target_rows(recording: SkinRecording, target: str) -> np.ndarray:
    """Rows that a head of a target can learn from: those where it is known and where the skin is touched.

    Args:
        recording: of one skin.
        target: name in `HEAD_TARGETS`.

    Returns:
        Row numbers.

    Raises:
        ValueError: there are too few, or they are all alike; one sentence.
    """
    if target not in HEAD_TARGETS:
        raise ValueError(f"{target!r} is no target of a head; choose of {', '.join(HEAD_TARGETS)}")
    known = recording.known(target)
    if target == "position" and recording.labels is not None and len(np.unique(recording.labels)) > 1:
        raise ValueError(
            f"several objects touched the skin in {recording.name}, whose origins are not where they touch"
        )
    if target in ("position", "depth") and recording.known("contact").any():
        known &= ~(recording.targets["contact"][:, 0] == 0)
    if target in ("position", "depth") and not recording.known("depth").any() and recording.known("shear").any():
        known &= recording.known("shear") & (np.abs(np.nan_to_num(recording.targets["shear"])).max(1) > 0)
    if not known.any():
        raise ValueError(f"{recording.name} does not know {target}")
    chosen = recording.rows(known)
    if known.sum() < MIN_HEAD_ROWS:
        raise ValueError(f"{recording.name} knows {target} of {known.sum()} rows: {MIN_HEAD_ROWS} are needed")
    if not chosen.varies(target):
        raise ValueError(f"{recording.name} has one {target} only, so that no head can be fitted to it")
    return np.flatnonzero(known)


def hold_out_groups(recording: SkinRecording) -> np.ndarray:
    """Groups held out whole: objects where there are several, blocks of the skin where presses lie in several (6 mm, or
    a quarter of a smaller range), else strokes, else stretches of time.

    Args:
        recording: of one skin.

    Returns:
        (n,) number of the group of each row.
    """
    if recording.labels is not None and len(np.unique(recording.labels)) > 1:
        return np.unique(recording.labels, return_inverse=True)[1].ravel()
    known = recording.known("position")
    position = recording.targets["position"] if known.all() else np.zeros((len(recording), 2))
    ranges = np.ptp(position, axis=0)
    # Strokes along a line come back to the same places: there the stroke is what rows share.
    if ranges.min() > TARGETS["position"].min_range or (
        ranges.max() > TARGETS["position"].min_range and not recording.session.any()
    ):
        edge = min(BLOCK_M, float(ranges.max()) / BLOCKS_ACROSS)
        return square_blocks(position, edge)
    if len(np.unique(recording.session)) >= MIN_BLOCKS:
        return np.unique(recording.session, return_inverse=True)[1].ravel()
    stretches = min(TIME_STRETCHES, len(recording))
    return np.arange(len(recording)) * stretches // max(len(recording), 1)


def _ways_of_grouping(recording: SkinRecording) -> np.ndarray:
    """Groups (ways, n) that are held out whole: blocks or strokes for places between known ones, and single presses for
    places among them; rows of a stroke are no presses of their own.
    """
    groups = hold_out_groups(recording)
    if is_stream(recording) or not recording.varies("position"):
        return groups[None]
    return np.stack([groups, np.arange(len(recording))])


def _fold_numbers(groups: np.ndarray, seed: int) -> np.ndarray:
    """Number of the fold (n,) of each row, in folds of whole groups."""
    _, group = np.unique(groups, return_inverse=True)
    order = np.random.default_rng(seed).permutation(group.max() + 1)
    return order[group.ravel()] % min(FOLD_COUNT, group.max() + 1)


def _with_history(readings: np.ndarray, session: np.ndarray, history: int) -> np.ndarray:
    """Readings and their differences (n, (1 + history) c) from each of the rows before, zero where a session begins."""
    columns, last = [readings], readings
    for _ in range(history):
        shifted = np.concatenate([last[:1], last[:-1]])
        begins = np.concatenate([[True], np.diff(session) != 0])
        last = np.where(begins[:, None], last, shifted)
        columns.append(readings - last)
    return np.concatenate(columns, axis=1)


class _Trial(NamedTuple):
    """A method on the rows at hand, each fold predicted from the others."""

    settings: Settings
    history: int
    predicted: np.ndarray  # (ways, n, d)
    error: float  # geometric mean over the ways


class _Candidate(NamedTuple):
    """Candidate: weights of methods, and perhaps other weights near known readings."""

    trial: _Trial
    methods: dict[str, _Trial]
    weights: dict[str, float]
    near: "_Candidate | None" = None
    gate: np.ndarray | None = None  # distances up to which it is that one, and from which it is not


class _Trials(NamedTuple):
    """Data for trials of methods."""

    looked: dict[int, np.ndarray]  # readings with so many rows of history
    values: np.ndarray
    folds: np.ndarray
    budget: HeadBudget

    def best(self, method: str, ways: slice) -> _Trial:
        """A method with the settings and the history that are best in some ways of holding out."""
        trials = []
        for history, readings in self.looked.items():
            settings = choose_settings(method, readings, self.values, self.folds[ways], self.budget)
            predicted = cross_predict(method, settings, readings, self.values, self.folds, budget=self.budget)
            trials.append(_judged(predicted, self.values, settings, history))
        return min(trials, key=lambda trial: trial.error)


def _judged(predicted: np.ndarray, values: np.ndarray, settings: Settings = (), history: int = 0) -> _Trial:
    errors = [max(_root_mean_square(way - values), 1e-12) for way in predicted]
    return _Trial(settings, history, predicted, float(np.exp(np.mean(np.log(errors)))))


def _root_mean_square(errors: np.ndarray) -> float:
    """Root of the mean square length of errors (..., d)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1))))


def _name_of(methods: Mapping[str, Any]) -> str:
    return STACKED_METHODS if len(methods) > 1 else next(iter(methods))


def _one(name: str, trial: _Trial) -> _Candidate:
    return _Candidate(trial, {name: trial}, {name: 1.0})


def _weighted(found: dict[str, _Trial], trials: _Trials, ways: slice) -> _Candidate:
    """The weighted sum of methods with the least error in some ways of holding out. Weights of a fold come from the
    others.
    """
    values, predicted = trials.values, np.stack([trial.predicted for trial in found.values()])
    fold, chosen = trials.folds[ways][0], predicted[:, ways]
    summed = np.empty(predicted.shape[1:])
    for i in np.unique(fold):
        out = fold == i
        shares, centre = _stack_weights(chosen[:, :, ~out], values[~out])
        summed[:, out] = centre + np.tensordot(shares, predicted[:, :, out] - centre, 1)
    shares = _stack_weights(chosen, values)[0]
    weights = {name: float(share) for name, share in zip(found, shares, strict=True) if share > MIN_WEIGHT}
    if len(weights) < 2:
        name = min(found, key=lambda name: found[name].error)
        return _one(name, found[name])
    return _Candidate(_judged(summed, values), found, weights)


def _choose(sets: list[dict[str, _Trial]], ways: list[slice], trials: _Trials, distance: np.ndarray) -> _Candidate:
    """Candidate of least error: single methods, weighted sums, or one of these for each of two ways."""
    values = trials.values
    singles = [[_one(name, found[name]) for name in found] for found in sets]
    candidates = [
        *(one for found in singles for one in found),
        *(_weighted(found, trials, slice(None)) for found in sets),
    ]
    if len(sets) > 1:
        of_blocks, of_presses = (
            [*alone, _weighted(found, trials, way)] for way, found, alone in zip(ways, sets, singles, strict=True)
        )
        far = min(of_blocks, key=lambda one: _root_mean_square(one.trial.predicted[0] - values))
        for near, shares in product(of_presses, GATES):
            gate = np.array([np.quantile(distance[way], share) for way, share in zip((1, 0), shares, strict=True)])
            gate = np.maximum.accumulate(gate)
            both = _gated(gate, distance, near.trial.predicted, far.trial.predicted)
            candidates.append(_Candidate(_judged(both, values), far.methods, far.weights, near, gate))
    return min(candidates, key=lambda one: one.trial.error)


def _gated(gate: np.ndarray, distance: np.ndarray, near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Prediction near known readings, blended into the prediction far from them."""
    share = np.clip((distance - gate[0]) / max(gate[1] - gate[0], 1e-12), 0, 1)[..., None]
    return (1 - share) * near + share * far


def _stack_weights(predicted: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights >= 0 with the least squared error of the sum about the mean of the values (d,)."""
    centre, scale = values.mean(0), np.maximum(values.std(0), 1e-12)
    columns = ((predicted - centre) / scale).reshape(len(predicted), -1).T
    wanted = np.broadcast_to((values - centre) / scale, predicted.shape[1:])
    return nnls(columns, wanted.ravel())[0], centre


def _fit_stack(kept: _Candidate, trials: _Trials) -> StackRecord:
    """Fit each method that has a weight to all rows."""
    fields = dict(zip(HEAD_METHODS, StackRecord._fields[-len(HEAD_METHODS) :], strict=True))
    found = {name: kept.methods[name] for name in kept.weights}
    parts = {
        fields[name]: fit_regression(
            name, trial.settings, trials.looked[trial.history], trials.values, budget=trials.budget
        )
        for name, trial in found.items()
    }
    return StackRecord(
        centre=trials.values.mean(0),
        weights=np.array([kept.weights.get(name, 0.0) for name in HEAD_METHODS]),
        histories=np.array([found[name].history if name in found else 0 for name in HEAD_METHODS]),
        **parts,
    )


def _predict_stack(stack: StackRecord, readings: np.ndarray, history: int) -> np.ndarray:
    """Predict by a weighted sum from readings with so many rows of history."""
    deviation = np.zeros((len(readings), len(stack.centre)))
    for name, part in stack.parts.items():
        i = HEAD_METHODS.index(name)
        looked = readings[:, : readings.shape[1] * (1 + int(stack.histories[i])) // (1 + history)]
        deviation += stack.weights[i] * (predict_regression(part, looked) - stack.centre)
    return stack.centre + deviation


def _fold_distances(readings: np.ndarray, folds: np.ndarray) -> np.ndarray:
    """Distance (ways, n) of each reading from the nearest of other folds, in features."""
    x = make_feature_map(FEATURES_OF_SPREAD, readings)(readings)
    distance = np.empty(folds.shape)
    for way, of in enumerate(folds):
        for fold in np.unique(of):
            out = of == fold
            distance[way, out] = nearest_known(x[~out], x[out], 1)[0][:, 0]
    return distance


def _fit_spread(readings: np.ndarray, errors: np.ndarray, groups: np.ndarray, distance: np.ndarray) -> SpreadRecord:
    """Fit a reading's spread to errors on held-out folds of whole groups (ways, n)."""
    features = make_feature_map(FEATURES_OF_SPREAD, readings)
    x = features(readings)
    raw = np.concatenate([_likeness(readings, way) for way in distance])
    flat = errors.reshape(-1, errors.shape[-1])
    middle, width = raw.mean(0), np.maximum(raw.std(0), 1e-6)
    record = SpreadRecord(
        features=features,
        known=x[subsample(len(x), HeadBudget().known_rows)],
        likeness=(raw - middle) / width,
        middle=middle,
        width=width,
        square=flat**2,
        factor=np.ones(flat.shape[1]),
        far=np.array(UNFAMILIAR_FACTOR * np.quantile(distance, UNFAMILIAR_QUANTILE)),
    )
    ratio = (np.abs(flat) / _alike(record, record.likeness, leave_out_itself=True)).reshape(errors.shape)
    # In the way of holding out that needs most: between known places, as a rule.
    factor = np.max([_factor_of_groups(*way) for way in zip(ratio, groups, strict=True)], axis=0)
    return record._replace(factor=np.maximum(factor / STDS_WITHIN_90, 1e-3))


def _factor_of_groups(ratio: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Factor (d,) over nine in ten of the ratios (n, d) in nine of ten groups, with one more group to come."""
    each = np.array([np.quantile(ratio[group == one], RANGE_SHARE, axis=0) for one in np.unique(group)])
    return np.quantile(each, min(RANGE_SHARE * (1 + 1 / len(each)), 1.0), axis=0)


def _spread(record: SpreadRecord, readings: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Standard deviations (n, d) at this distance from the nearest known reading."""
    likeness = (_likeness(readings, distance) - record.middle) / record.width
    return _alike(record, likeness) * record.factor


def _likeness(readings: np.ndarray, distance: np.ndarray) -> np.ndarray:
    return np.column_stack([np.log(np.linalg.norm(readings, axis=1) + 1e-3), np.log(distance + 1e-6)])


def _alike(record: SpreadRecord, likeness: np.ndarray, *, leave_out_itself: bool = False) -> np.ndarray:
    """Root mean square error of the held-out rows that are most alike."""
    n = len(record.likeness)
    k = min(max(ALIKE_ROWS, round(ALIKE_SHARE * n)), n - 1)
    near = cKDTree(record.likeness).query(likeness, k + leave_out_itself)[1].reshape(len(likeness), -1)
    square = np.mean(record.square[near[:, int(leave_out_itself) :]], axis=1)
    return np.sqrt(square + 1e-6 * np.mean(record.square, axis=0) + 1e-18)
