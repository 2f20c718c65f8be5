"""Heads: contact estimates from a skin's readings. Position, depth, normal force and shear with their spread; contact
and slip as probabilities.

    from i2t.calibration.heads import fit_head, read_recordings

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
nine strokes it is that of the worst. Probabilities come from the same errors by Platt's logistic map (Platt, Advances
in Large Margin Classifiers, 1999). A reading that lies farther from all known ones than these do from each other is
`unfamiliar`: a skin that changed, another tip, or a magnet near by.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize, nnls
from scipy.spatial import cKDTree

from i2t import serialization
from i2t.calibration.heads.recording import MIN_CHANGE, TARGETS, SkinRecording
from i2t.calibration.heads.regression import (
    HEAD_METHODS,
    MEAN_TARGET,
    READINGS_NETWORK,
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
    some_rows,
)
from i2t.dataset import square_blocks

FILE_KIND_OF_HEAD = "i2t head"
STACKED_METHODS = "weighted methods"
MIN_WEIGHT = 0.02  # of a method in a sum
FOLD_COUNT = 5
MIN_HEAD_ROWS = 20  # of a head: fewer leave nothing to choose and to test on
MIN_BLOCKS = 5  # of the skin, that blocks are held out of
BLOCK_M = 6e-3
BLOCKS_ACROSS = 4  # of a range too small for blocks of BLOCK_M
TIME_STRETCHES = 10  # of a recording of one position
RANGE_SHARE = 0.9  # of rows in a stated range, and of groups that hold as many
STDS_OF_90_PERCENT = 1.645  # standard deviations of a normal error that hold nine in ten
ALIKE_SHARE = 0.05  # of the rows, whose errors say how far off the head is for a reading like them
ALIKE_ROWS = 30  # at least
UNFAMILIAR_QUANTILE = 0.999  # of distances between known readings
UNFAMILIAR_FACTOR = 2.0
# Shares of single presses, and of blocks, whose distances from known readings end what is near and begin what is far.
GATES = ((0.5, 0.5), (0.9, 0.5), (0.9, 0.1))
FEATURES_OF_SPREAD = 0  # index into FEATURE_KINDS
STREAM_GAP_S = 0.5  # rows farther apart are no stream
STREAM_HISTORY = 3  # rows: what a skin remembers, and how it moves


class HeadPrediction(NamedTuple):
    """Predictions of a head."""

    mean: Float[np.ndarray, "n d"]  # in the library's unit, or a probability; NaN where a reading is not finite
    std: Float[np.ndarray, "n d"]  # likewise; of a probability p the square root of p (1 - p)
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
    platt: Float[np.ndarray, " 2"]  # slope and offset of the probability's logit


class StackRecord(NamedTuple):
    """A weighted sum of methods about the mean, m + sum w_i (f_i - m); None for a method without weight."""

    centre: Float[np.ndarray, " d"]  # m, of the targets
    weights: Float[np.ndarray, " methods"]  # in the order of HEAD_METHODS
    histories: Int[np.ndarray, " methods"]  # rows before a reading that each looks at
    mean: Regression | None = None
    linear: Regression | None = None
    nearest: Regression | None = None
    gaussian_process: Regression | None = None
    network: Regression | None = None

    @property
    def parts(self) -> dict[str, Regression]:
        """Methods that have a weight."""
        every = (self.mean, self.linear, self.nearest, self.gaussian_process, self.network)
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
        target: its name in `TARGETS`.
        record: arrays of it.
        validation: error of each method on held-out blocks of the recording, by which this one was chosen: root mean
            square in the library's unit, or root of the Brier score of a probability.
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

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each method; far from known readings where others are used near them."""
        weights = dict(zip(HEAD_METHODS, map(float, self.record.stack.weights), strict=True))
        return {name: weights[name] for name in self.record.stack.parts}

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
        readings = np.asarray(readings, np.float64)
        record = self.record
        if readings.ndim != 2 or readings.shape[1] != record.values:
            raise ValueError(f"readings {readings.shape} are not of the {record.values} channels that the head knows")
        session = np.zeros(len(readings), int) if session is None else np.asarray(session)
        looked = with_history(readings[:, record.channels], session, int(record.history))
        good = np.isfinite(looked).all(1)
        d = len(record.stack.centre)
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
        if TARGETS[self.target].yes_no:
            mean = _logistic(record.spread.platt[0] * mean + record.spread.platt[1])
            std = np.sqrt(mean * (1 - mean))
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
        if about.get("target") not in TARGETS:
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
        target: name in `TARGETS`.
        methods: of `regression.HEAD_METHODS` that are tried; the mean always is.
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
    rows = rows[some_rows(len(rows), budget.rows)]
    channels = used_channels(recording.readings[rows])
    if not len(channels):
        raise ValueError(f"{recording.name}: no channel changes, so that {target} cannot be predicted from them")
    values, known = recording.targets[target][rows], recording.rows(rows)
    groups = _ways_of_grouping(known)
    folds = np.stack([fold_numbers(of, FOLD_COUNT, seed) for of in groups])
    tried = [
        MEAN_TARGET,
        *(name for name in methods if name != MEAN_TARGET and (name != READINGS_NETWORK or budget.network_steps)),
    ]
    yes_no = TARGETS[target].yes_no
    trials = _Trials(recording, channels, rows, values, folds, budget=budget, yes_no=yes_no)
    tried_histories = histories(recording) if history is None else (history,)
    # Settings that are best in each way of holding out; of a probability, which is of one scale, in all together.
    ways = [slice(None)] if yes_no else [slice(way, way + 1) for way in range(len(folds))]
    sets = [trials.best(tried, tried_histories, way) for way in ways]
    readings = trials.readings(0)
    distance = _fold_distances(readings, folds)
    best = _choose(sets, ways, trials, distance)
    used = [best, *([best.near] if best.near else [])]
    history = max(one.methods[name].history for one in used for name in one.weights)
    stack, *near_stack = (_fit_stack(one, trials.readings(history), values, budget, history) for one in used)
    record = HeadRecord(
        stack=stack,
        spread=_fit_spread(readings, best.trial.predicted - values, groups, distance, best.trial.platt),
        values=np.array(recording.readings.shape[1]),
        channels=channels,
        history=np.array(history),
        near_stack=near_stack[0] if near_stack else None,
        gate=best.gate,
    )
    validation = {name: min(found[name].error for found in sets) for name in tried}
    head = Head(target, record, validation, metadata or {})
    if head.method not in validation:
        validation[head.method] = best.trial.error
    return head


def histories(recording: SkinRecording) -> tuple[int, ...]:
    """Numbers of rows before a reading that a head may use: none, and in a stream a few.

    Args:
        recording: of one skin.

    Returns:
        What is tried.
    """
    return (0, STREAM_HISTORY) if is_stream(recording) else (0,)


def is_stream(recording: SkinRecording) -> bool:
    """Test for rows in quick sequence, as samples of one contact are.

    Args:
        recording: of one skin.

    Returns:
        False where times are not known.
    """
    gap = np.diff(recording.time)
    return bool(np.isfinite(gap).any() and np.nanmedian(gap) < STREAM_GAP_S)


def target_rows(recording: SkinRecording, target: str) -> np.ndarray:
    """Rows that a head of a target can learn from: those where it is known and where the skin is touched.

    Args:
        recording: of one skin.
        target: name in `TARGETS`.

    Returns:
        Row numbers.

    Raises:
        ValueError: there are too few, or they are all alike; one sentence.
    """
    if target not in TARGETS:
        raise ValueError(f"{target!r} is no target; choose of {', '.join(TARGETS)}")
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


def used_channels(readings: Float[np.ndarray, "n c"]) -> np.ndarray:
    """Channels that change.

    Args:
        readings: uT.

    Returns:
        Their numbers.
    """
    return np.flatnonzero(np.ptp(readings, axis=0) > 0)


def with_history(
    readings: Float[np.ndarray, "n c"], session: Int[np.ndarray, " n"], history: int
) -> Float[np.ndarray, "n k"]:
    """Readings, and their differences from each of the rows before, zero where a session begins.

    Args:
        readings: uT, in the order of time.
        session: in which rows follow each other.
        history: number of rows before.

    Returns:
        (n, (1 + history) c) uT.
    """
    columns, last = [readings], readings
    for _ in range(history):
        shifted = np.concatenate([last[:1], last[:-1]])
        begins = np.concatenate([[True], np.diff(session) != 0])
        last = np.where(begins[:, None], last, shifted)
        columns.append(readings - last)
    return np.concatenate(columns, axis=1)


def hold_out_groups(recording: SkinRecording, block_m: float = BLOCK_M) -> np.ndarray:
    """Groups held out whole: objects where there are several, blocks of the skin where presses lie in several, else
    strokes, else stretches of time.

    Args:
        recording: of one skin.
        block_m: m, edge of a block; smaller where the positions span less than four of them.

    Returns:
        (n,) number of the group of each row.
    """
    if recording.labels is not None and len(np.unique(recording.labels)) > 1:
        return np.unique(recording.labels, return_inverse=True)[1].ravel()
    known = recording.known("position")
    position = recording.targets["position"] if known.all() else np.zeros((len(recording), 2))
    ranges = np.ptp(position, axis=0)
    # Strokes along a line come back to the same places: there the stroke is what rows share.
    if ranges.min() > MIN_CHANGE["position"] or (ranges.max() > MIN_CHANGE["position"] and not recording.session.any()):
        edge = min(block_m, float(ranges.max()) / BLOCKS_ACROSS)
        return square_blocks(position, edge)
    if len(np.unique(recording.session)) >= MIN_BLOCKS:
        return np.unique(recording.session, return_inverse=True)[1].ravel()
    stretches = min(TIME_STRETCHES, len(recording))
    return np.arange(len(recording)) * stretches // max(len(recording), 1)


def fold_numbers(groups: Int[np.ndarray, " n"], folds: int, seed: int) -> Int[np.ndarray, " n"]:
    """Folds of whole groups.

    Args:
        groups: of each row.
        folds: how many, at most as many as groups.
        seed: of the folds.

    Returns:
        (n,) number of the fold of each row.
    """
    _, group = np.unique(groups, return_inverse=True)
    order = np.random.default_rng(seed).permutation(group.max() + 1)
    return order[group.ravel()] % min(folds, group.max() + 1)


def root_mean_square(errors: Float[np.ndarray, "*n d"]) -> float:
    """Root of the mean square length of errors.

    Args:
        errors: in any unit.

    Returns:
        In the same.
    """
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1))))


def _ways_of_grouping(recording: SkinRecording) -> np.ndarray:
    """Groups (ways, n) that are held out whole: blocks or strokes for places between known ones, and single presses for
    places among them; rows of a stroke are no presses of their own.
    """
    groups = hold_out_groups(recording)
    if is_stream(recording) or not recording.varies("position"):
        return groups[None]
    return np.stack([groups, np.arange(len(recording))])


class _Trial(NamedTuple):
    """A method on the rows at hand, each fold predicted from the others."""

    settings: Settings
    history: int
    predicted: np.ndarray  # (ways, n, d)
    platt: np.ndarray  # (2,)
    error: float  # geometric mean over the ways


class _Candidate(NamedTuple):
    """Candidate: weights of methods, and perhaps other weights near known readings."""

    trial: _Trial
    methods: dict[str, _Trial]
    weights: dict[str, float]
    near: "_Candidate | None" = None
    gate: np.ndarray | None = None  # distances up to which it is that one, and from which it is not


@dataclass(frozen=True)
class _Trials:
    """Data for trials of methods."""

    recording: SkinRecording
    channels: np.ndarray
    rows: np.ndarray
    values: np.ndarray
    folds: np.ndarray
    budget: HeadBudget
    yes_no: bool

    def readings(self, history: int) -> np.ndarray:
        """Readings of the rows, with their history."""
        looked = with_history(self.recording.readings[:, self.channels], self.recording.session, history)
        return looked[self.rows]

    def best(self, methods: Sequence[str], histories: Sequence[int], ways: slice) -> dict[str, _Trial]:
        """Each method with the settings that are best in some ways of holding out."""
        found: dict[str, _Trial] = {}
        for history in histories:
            readings = self.readings(history)
            for name in methods:
                settings = choose_settings(name, readings, self.values, self.folds[ways], self.budget)
                predicted = cross_predict(name, settings, readings, self.values, self.folds, budget=self.budget)
                trial = _judged(settings, history, predicted, self.values, yes_no=self.yes_no)
                if name not in found or trial.error < found[name].error:
                    found[name] = trial
        return found


def _judged(settings: Settings, history: int, predicted: np.ndarray, values: np.ndarray, *, yes_no: bool) -> _Trial:
    platt = np.zeros(2)
    shown = predicted
    if yes_no:
        platt = _platt(predicted[..., 0], np.broadcast_to(values[:, 0], predicted.shape[:2]))
        shown = _logistic(platt[0] * predicted + platt[1])
    errors = [max(root_mean_square(way - values), 1e-12) for way in shown]
    return _Trial(settings, history, predicted, platt, float(np.exp(np.mean(np.log(errors)))))


def _name_of(methods: Mapping[str, Any]) -> str:
    return STACKED_METHODS if len(methods) > 1 else next(iter(methods))


def _one(name: str, trial: _Trial) -> _Candidate:
    return _Candidate(trial, {name: trial}, {name: 1.0})


def _weighted(
    found: dict[str, _Trial], values: np.ndarray, folds: np.ndarray, ways: slice, *, yes_no: bool
) -> _Candidate:
    """The weighted sum of methods with the least error in some ways of holding out. Weights of a fold come from the
    others.
    """
    predicted = np.stack([trial.predicted for trial in found.values()])
    fold, chosen = folds[ways][0], predicted[:, ways]
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
    return _Candidate(_judged((), 0, summed, values, yes_no=yes_no), found, weights)


def _choose(sets: list[dict[str, _Trial]], ways: list[slice], trials: _Trials, distance: np.ndarray) -> _Candidate:
    """Candidate of least error: single methods, weighted sums, or one of these for each of two ways."""
    values, folds, yes_no = trials.values, trials.folds, trials.yes_no
    singles = [[_one(name, found[name]) for name in found] for found in sets]
    candidates = [
        *(one for found in singles for one in found),
        *(_weighted(found, values, folds, slice(None), yes_no=yes_no) for found in sets),
    ]
    if len(sets) > 1:
        of_blocks, of_presses = (
            [*alone, _weighted(found, values, folds, way, yes_no=yes_no)]
            for way, found, alone in zip(ways, sets, singles, strict=True)
        )
        far = min(of_blocks, key=lambda one: root_mean_square(one.trial.predicted[0] - values))
        for near, shares in product(of_presses, GATES):
            gate = np.array([np.quantile(distance[way], share) for way, share in zip((1, 0), shares, strict=True)])
            gate = np.maximum.accumulate(gate)
            both = _gated(gate, distance, near.trial.predicted, far.trial.predicted)
            trial = _judged((), 0, both, values, yes_no=yes_no)
            candidates.append(_Candidate(trial, far.methods, far.weights, near, gate))
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


def _fit_stack(
    kept: _Candidate, readings: np.ndarray, values: np.ndarray, budget: HeadBudget, history: int
) -> StackRecord:
    """Fit each method that has a weight to all rows; `readings` hold so many rows of history."""
    fields = dict(zip(HEAD_METHODS, StackRecord._fields[-len(HEAD_METHODS) :], strict=True))
    weights, parts = kept.weights, {}
    found = {name: kept.methods[name] for name in weights}
    for name, trial in found.items():
        looked = readings[:, : readings.shape[1] * (1 + trial.history) // (1 + history)]
        parts[fields[name]] = fit_regression(name, trial.settings, looked, values, budget=budget)
    return StackRecord(
        centre=values.mean(0),
        weights=np.array([weights.get(name, 0.0) for name in HEAD_METHODS]),
        histories=np.array([found[name].history if name in found else 0 for name in HEAD_METHODS]),
        **parts,
    )


def _predict_stack(stack: StackRecord, readings: np.ndarray, history: int) -> np.ndarray:
    """Predict by a weighted sum from readings with rows of history."""
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


def _fit_spread(
    readings: np.ndarray, errors: np.ndarray, groups: np.ndarray, distance: np.ndarray, platt: np.ndarray
) -> SpreadRecord:
    """Fit a reading's spread to errors on held-out folds of whole groups (ways, n)."""
    features = make_feature_map(FEATURES_OF_SPREAD, readings)
    x = features(readings)
    raw = np.concatenate([_likeness(readings, way) for way in distance])
    flat = errors.reshape(-1, errors.shape[-1])
    middle, width = raw.mean(0), np.maximum(raw.std(0), 1e-6)
    record = SpreadRecord(
        features=features,
        known=x[some_rows(len(x), HeadBudget().known_rows)],
        likeness=(raw - middle) / width,
        middle=middle,
        width=width,
        square=flat**2,
        factor=np.ones(flat.shape[1]),
        far=np.array(UNFAMILIAR_FACTOR * np.quantile(distance, UNFAMILIAR_QUANTILE)),
        platt=platt,
    )
    ratio = (np.abs(flat) / _alike(record, record.likeness, leave_out_itself=True)).reshape(errors.shape)
    # In the way of holding out that needs most: between known places, as a rule.
    factor = np.max([_factor_of_groups(*way) for way in zip(ratio, groups, strict=True)], axis=0)
    return record._replace(factor=np.maximum(factor / STDS_OF_90_PERCENT, 1e-3))


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


def _platt(score: np.ndarray, answer: np.ndarray) -> np.ndarray:
    """Slope and offset of the logistic map from score to probability, with Platt's corrected targets."""
    yes, no = np.sum(answer > 0.5), np.sum(answer <= 0.5)
    wanted = np.where(answer > 0.5, (yes + 1) / (yes + 2), 1 / (no + 2))
    middle, width = score.mean(), score.std() + 1e-9

    def loss(ab: np.ndarray) -> float:
        logit = ab[0] * (score - middle) / width + ab[1]
        return float(np.mean(np.logaddexp(0, logit) - wanted * logit))

    slope, offset = minimize(loss, np.array([1.0, 0.0]), method="BFGS").x
    return np.array([slope / width, offset - slope * middle / width])


def _logistic(logit: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(logit, -30, 30)))
