"""Heads: estimates of position, travel, normal force and shear from a skin's readings, with their uncertainty.

    from i2t.heads.heads import fit_head
    from i2t.recordings.read import read_recordings

    (recording,) = read_recordings("my_presses.csv")
    head = fit_head(recording, "position")
    predicted = head.predict(readings)                     # (n, c) uT
    predicted.mean, predicted.std, predicted.unfamiliar    # (n, 2) m, (n, 2) m, (n,)
    head.save("position.npz")

A head is one of the methods of `regression`, or a weighted sum of them (stacked regression; Breiman, Machine Learning
24, 1996). It has the smallest error on held-out blocks of the skin and held-out single presses; in a stream, or if the
position is constant or unknown, on held-out strokes or stretches of time. The mean, a linear map and the k nearest
readings are among the methods, so a head never loses to them there. The method that is best where presses return to
known places (single presses held out) may not be best elsewhere (blocks held out). If two methods are better than one,
a head keeps both, and changes from one to the other with a reading's distance from the known ones.

The standard deviation of a prediction comes from the errors on the same blocks, at readings of similar length and
distance from the known ones. A factor brings nine in ten readings of nine in ten blocks or strokes into the 90 % range:
rows of one stroke err alike, so strokes are exchangeable and rows are not (cross-conformal prediction; Vovk, Annals of
Mathematics and Artificial Intelligence 74, 2015; for groups, Dunn, Wasserman and Ramdas, J. Am. Stat. Assoc. 118,
2023). With fewer than nine strokes the worst one sets the factor. A reading that is farther from all known ones than
they are from each other is `unfamiliar`: the skin changed, the tip is another, or a magnet is near.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, product
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
    FeatureKind,
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
from i2t.recordings.read import TARGETS, SkinRecording, is_stream

FILE_KIND_OF_HEAD = "i2t head"  # kind of file in the header of a saved head
# targets that a head can predict: all but the binary ones
HEAD_TARGETS = tuple(name for name, kind in TARGETS.items() if not kind.binary)


@dataclass(frozen=True)
class HeadConfig:
    """Settings for validating a head (a regression from readings) and for the uncertainty of its predictions.

    Attributes:
        min_rows: Number of rows that a head needs; fewer leave nothing to choose and to test on.
        fold_count: Number of folds of the cross-validation, at most.
        block_m: Edge (m) of the square blocks of the skin that are held out.
        blocks_across: Number of blocks across a range of positions that is too small for `block_m`.
        min_strokes: Number of strokes (sessions) from which whole strokes are held out.
        time_stretches: Number of stretches of time that are held out if there are neither blocks nor strokes.
        stream_history: Number of earlier rows that a head of a stream may use, because a skin has a memory and moves.
        min_weight: Weight from which a method belongs to the weighted sum of methods.
        gates: Pairs to try: the quantile of the distances of single held-out presses from known readings at which the
            near region ends, and that of held-out blocks at which the far region begins.
        range_share: Fraction of the rows in a stated range, and of the groups that hold as many.
        similar_share: Fraction of the rows whose errors determine the uncertainty of a similar reading.
        min_similar_rows: Smallest number of these rows.
        unfamiliar_quantile: Quantile of the distances between known readings.
        unfamiliar_factor: Factor on that quantile from which a reading is unfamiliar.
    """

    min_rows: int = 20
    fold_count: int = 5
    block_m: float = 6e-3
    blocks_across: int = 4
    min_strokes: int = 5
    time_stretches: int = 10
    stream_history: int = 3
    min_weight: float = 0.02
    gates: tuple[tuple[float, float], ...] = ((0.5, 0.5), (0.9, 0.5), (0.9, 0.1))
    range_share: float = 0.9
    similar_share: float = 0.05
    min_similar_rows: int = 30
    unfamiliar_quantile: float = 0.999
    unfamiliar_factor: float = 2.0


HEAD_CONFIG = HeadConfig()  # default validation of heads, and the uncertainty of their predictions


class HeadPrediction(NamedTuple):
    """Predicted target for n readings (m or N): mean, standard deviation and whether a reading is unfamiliar."""

    mean: Float[np.ndarray, "n d"]  # predicted target in the library's unit; NaN if a reading is not finite
    std: Float[np.ndarray, "n d"]  # standard deviation in the library's unit; NaN if a reading is not finite
    unfamiliar: Bool[np.ndarray, " n"]  # whether the reading is far from all known ones


class SpreadRecord(NamedTuple):
    """Squared errors of a head on held-out rows, and features of their readings, from which its uncertainty follows."""

    features: FeatureMap
    known: Float[np.ndarray, "m k"]  # features of known readings
    likeness: Float[np.ndarray, "m 2"]  # log length and log distance from other folds, standardised
    middle: Float[np.ndarray, " 2"]  # mean of the log lengths and log distances before standardisation
    width: Float[np.ndarray, " 2"]  # standard deviation of the log lengths and log distances before standardisation
    square: Float[np.ndarray, "m d"]  # squared errors of the known readings
    factor: Float[np.ndarray, " d"]  # factor on the predicted standard deviation
    far: Float[np.ndarray, ""]  # distance from which a reading is unfamiliar


class StackRecord(NamedTuple):
    """Weighted sum of regression methods f_i about the targets' mean m: m + sum w_i (f_i - m); unused ones are None."""

    centre: Float[np.ndarray, " d"]  # m, mean of the targets
    weights: Float[np.ndarray, " methods"]  # weights of the methods, in the order of HEAD_METHODS
    histories: Int[np.ndarray, " methods"]  # number of earlier rows that each method uses
    mean: Regression | None = None
    linear: Regression | None = None
    nearest: Regression | None = None
    gaussian_process: Regression | None = None

    @property
    def parts(self) -> dict[str, Regression]:
        """Regression methods that have a weight in the sum, by name."""
        parts = (self.mean, self.linear, self.nearest, self.gaussian_process)
        return {name: part for name, part in zip(HEAD_METHODS, parts, strict=True) if part is not None}


class HeadRecord(NamedTuple):
    """Fitted arrays of a head: weighted sums of regressions, data for the uncertainty, channels and history used."""

    stack: StackRecord
    spread: SpreadRecord
    values: Int[np.ndarray, ""]  # number of values of a reading of the skin
    channels: Int[np.ndarray, " used"]  # channels that the head uses
    history: Int[np.ndarray, ""]  # number of earlier rows that any method uses
    # stack that replaces `stack` near known readings; None if `stack` serves everywhere
    near_stack: StackRecord | None = None
    # distance up to which only `near_stack` predicts, and distance from which only `stack` predicts
    gate: Float[np.ndarray, " 2"] | None = None


@dataclass(frozen=True)
class Head:
    """Regression from a skin's readings to one target, such as force or position, from `fit_head` or `load_head`.

    Attributes:
        target: Name of the target, one of `HEAD_TARGETS`.
        record: Arrays of the head.
        validation: Root mean square error of each method on held-out blocks of the recording, in the target's unit;
            smaller is better, and the head has the smallest.
        metadata: Data that the caller saved with the head, in types that JSON can hold.
    """

    target: str
    record: HeadRecord
    validation: dict[str, float] = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)

    @property
    def method(self) -> str:
        """Name of the regression method or weighted sum; two names if another one serves near known readings."""
        near, far = self.record.near_stack, _name_of(self.record.stack.parts)
        return far if near is None else f"{_name_of(near.parts)} near, {far} far"

    def predict(
        self, readings: Float[np.ndarray, "n c"], session: Int[np.ndarray, " n"] | None = None
    ) -> HeadPrediction:
        """Predict the target from readings.

        Args:
            readings: `(n, c)` readings (uT) of all c channels of the skin, in the order of time if the head uses
                earlier rows.
            session: `(n,)` number of the stroke or session within which rows follow each other; None if there is one.

        Returns:
            Mean and standard deviation of the target for each reading, and whether it is unfamiliar. A reading that is
            not finite has NaN and is unfamiliar.

        Raises:
            ValueError: The readings are not of the skin that the head was fitted to.
        """
        readings, record = np.asarray(readings, np.float64), self.record
        if readings.ndim != 2 or readings.shape[1] != record.values:
            raise ValueError(
                f"readings {readings.shape} do not have the {record.values} channels that the head expects"
            )
        session = np.zeros(len(readings), int) if session is None else np.asarray(session)
        inputs = _with_history(readings[:, record.channels], session, int(record.history))
        finite, d = np.isfinite(inputs).all(1), len(record.stack.centre)
        mean, std = np.full((len(readings), d), np.nan), np.full((len(readings), d), np.nan)
        unfamiliar = np.ones(len(readings), bool)
        if finite.any():
            current = inputs[finite][:, : len(record.channels)]
            distance = nearest_known(record.spread.known, record.spread.features(current), 1)[0][:, 0]
            mean[finite] = _predict_stack(record.stack, inputs[finite], int(record.history))
            if record.near_stack is not None:
                assert record.gate is not None
                near = _predict_stack(record.near_stack, inputs[finite], int(record.history))
                mean[finite] = _blend(record.gate, distance, near, mean[finite])
            std[finite], unfamiliar[finite] = _spread(record.spread, current, distance), distance > record.spread.far
        return HeadPrediction(mean, std, unfamiliar)

    def save(self, path: Path | str) -> None:
        """Write the head to one file, which appears complete or not at all.

        Args:
            path: Path of the file, usually with the suffix `.npz`.

        Raises:
            SerializationError: The file cannot be written.
        """
        about = {"target": self.target, "validation": self.validation, "about": self.metadata}
        serialization.save(path, FILE_KIND_OF_HEAD, self.record, about)


def load_head(path: Path | str) -> Head:
    """Load a head (a regression from readings) from its file.

    Args:
        path: Path of a file that `Head.save` wrote.

    Returns:
        The head as it was saved.

    Raises:
        SerializationError: The file is missing, damaged or of another kind.
    """
    record, about = serialization.load(path, FILE_KIND_OF_HEAD, HeadRecord)
    with serialization.fitting(path):
        target = about.get("target")
        target = "travel" if target == "depth" else target  # name in earlier files
        if target not in HEAD_TARGETS:
            raise serialization.SerializationError(
                f"{path}: has a target that this version does not support; fit it again"
            )
        return Head(target, record, about["validation"], about["about"])


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
    """Fit a head, which predicts a target from readings, with the method that is best on held-out parts.

    Args:
        recording: Recording of one skin with readings and targets.
        target: Name of the target, one of `HEAD_TARGETS`.
        methods: Methods of `HEAD_METHODS` to try; the mean is always among them.
        history: Number of earlier rows that the head uses too. None means 0 for single presses, and the best number
            for a stream.
        budget: Largest numbers of rows to use; None for the default.
        seed: Seed of the folds.
        metadata: Data to save with the head, in types that JSON can hold.

    Returns:
        The head with the smallest error.

    Raises:
        ValueError: The recording lacks the target or has too little of it, or no channel changes.
    """
    budget = HeadBudget() if budget is None else budget
    rows = target_rows(recording, target)
    rows = rows[subsample(len(rows), budget.rows)]
    channels = np.flatnonzero(np.ptp(recording.readings[rows], axis=0) > 0)
    if not len(channels):
        raise ValueError(f"{recording.name}: no channel changes, so that {target} cannot be predicted from them")
    values = recording.targets[target][rows]
    groups = _ways_of_grouping(recording.rows(rows))
    folds = np.stack([_fold_numbers(group, seed) for group in groups])
    names = [MEAN_TARGET, *(name for name in methods if name != MEAN_TARGET)]
    default_histories = {0, HEAD_CONFIG.stream_history} if is_stream(recording) else {0}
    histories = default_histories if history is None else {history}
    inputs = {n: _with_history(recording.readings[:, channels], recording.session, n)[rows] for n in sorted(histories)}
    ways = [slice(way, way + 1) for way in range(len(folds))]
    trials = _Trials(inputs, values, folds, budget)
    best_of_ways = [{name: trials.best(name, way) for name in names} for way in ways]
    readings = recording.readings[rows][:, channels]
    distance = _fold_distances(readings, folds)
    best = _choose(best_of_ways, ways, trials, distance)
    stack = _fit_stack(best, trials)
    near_stack = _fit_stack(best.near, trials) if best.near else None
    record = HeadRecord(
        stack=stack,
        spread=_fit_spread(readings, best.trial.predicted - values, groups, distance),
        values=np.array(recording.readings.shape[1]),
        channels=channels,
        history=np.array(max(part.histories.max() for part in (stack, near_stack) if part is not None)),
        near_stack=near_stack,
        gate=best.gate,
    )
    validation = {name: min(best_of_way[name].error for best_of_way in best_of_ways) for name in names}
    head = Head(target, record, validation, metadata or {})
    validation.setdefault(head.method, best.trial.error)
    return head


def target_rows(recording: SkinRecording, target: str) -> np.ndarray:
    """Find the rows of a recording to which a head can be fitted: the target is known.

    For position and travel, the skin must also be touched, as far as contact or shear is recorded.

    Args:
        recording: Recording of one skin.
        target: Name of the target, one of `HEAD_TARGETS`.

    Returns:
        Row numbers in ascending order.

    Raises:
        ValueError: There are too few rows, or their targets do not vary.
    """
    if target not in HEAD_TARGETS:
        raise ValueError(f"{target!r} is not a target of a head; choose one of {', '.join(HEAD_TARGETS)}")
    usable = recording.known_rows(target)
    if target == "position" and recording.labels is not None and len(np.unique(recording.labels)) > 1:
        raise ValueError(f"several objects touched the skin in {recording.name}: the place of contact is unknown")
    if target in ("position", "travel") and recording.known_rows("contact").any():
        usable &= ~(recording.targets["contact"][:, 0] == 0)
    if (
        target in ("position", "travel")
        and not recording.known_rows("travel").any()
        and recording.known_rows("shear").any()
    ):
        usable &= recording.known_rows("shear") & (np.abs(np.nan_to_num(recording.targets["shear"])).max(1) > 0)
    count, min_rows = int(usable.sum()), HEAD_CONFIG.min_rows
    if not count:
        raise ValueError(f"{recording.name} has no known {target}")
    if count < min_rows:
        raise ValueError(f"{recording.name} has a known {target} in only {count} rows, but {min_rows} are needed")
    if not recording.rows(usable).varies(target):
        raise ValueError(f"{recording.name} has only one value of {target}, so no head can be fitted to it")
    return np.flatnonzero(usable)


def hold_out_groups(recording: SkinRecording) -> np.ndarray:
    """Group the rows of a recording that a validation holds out together.

    Groups are objects if there are several; else blocks of the skin if presses lie in several (6 mm, or a quarter of a
    smaller range); else strokes; else stretches of time.

    Args:
        recording: Recording of one skin.

    Returns:
        `(n,)` number of each row's group.
    """
    if recording.labels is not None and len(np.unique(recording.labels)) > 1:
        return np.unique(recording.labels, return_inverse=True)[1].ravel()
    position = (
        recording.targets["position"] if recording.known_rows("position").all() else np.zeros((len(recording), 2))
    )
    ranges, min_range = np.ptp(position, axis=0), TARGETS["position"].min_range
    # Strokes along a line return to the same places, so rows share the stroke and not the place.
    if ranges.min() > min_range or (ranges.max() > min_range and not recording.session.any()):
        edge = min(HEAD_CONFIG.block_m, float(ranges.max()) / HEAD_CONFIG.blocks_across)
        return square_blocks(position, edge)
    if len(np.unique(recording.session)) >= HEAD_CONFIG.min_strokes:
        return np.unique(recording.session, return_inverse=True)[1].ravel()
    stretches = min(HEAD_CONFIG.time_stretches, len(recording))
    return np.arange(len(recording)) * stretches // max(len(recording), 1)


def _ways_of_grouping(recording: SkinRecording) -> np.ndarray:
    """Group rows in each way of holding out, `(ways, n)`.

    Blocks or strokes test places between known ones, and single presses test known places. Rows of a stream are not
    single presses.
    """
    groups = hold_out_groups(recording)
    if is_stream(recording) or not recording.varies("position"):
        return groups[None]
    return np.stack([groups, np.arange(len(recording))])


def _fold_numbers(groups: np.ndarray, seed: int) -> np.ndarray:
    """Assign whole groups to folds: `(n,)` number of each row's fold."""
    _, group = np.unique(groups, return_inverse=True)
    order = np.random.default_rng(seed).permutation(group.max() + 1)
    return order[group.ravel()] % min(HEAD_CONFIG.fold_count, group.max() + 1)


def _with_history(readings: np.ndarray, session: np.ndarray, history: int) -> np.ndarray:
    """Append the differences of readings from each earlier row, `(n, (1 + history) c)`.

    Rows before the beginning of a session equal its first row.
    """
    columns, earlier = [readings], readings
    for _ in range(history):
        shifted = np.concatenate([earlier[:1], earlier[:-1]])
        begins = np.concatenate([[True], np.diff(session) != 0])
        earlier = np.where(begins[:, None], earlier, shifted)
        columns.append(readings - earlier)
    return np.concatenate(columns, axis=1)


class _Trial(NamedTuple):
    """A method with its settings, and its predictions of each fold from the others."""

    settings: Settings
    history: int
    predicted: np.ndarray  # (ways, n, d) predictions for each way of holding out rows
    error: float  # geometric mean of the errors over the ways of holding out rows


class _Candidate(NamedTuple):
    """A weighted sum of methods, and perhaps another one near known readings."""

    trial: _Trial
    methods: dict[str, _Trial]
    weights: dict[str, float]
    near: "_Candidate | None" = None
    gate: np.ndarray | None = None  # distance up to which only `near` predicts, and distance from which it does not


class _Trials(NamedTuple):
    """Data for trials of methods."""

    inputs: dict[int, np.ndarray]  # readings with their history, by the number of earlier rows
    values: np.ndarray
    folds: np.ndarray
    budget: HeadBudget

    def best(self, method: str, ways: slice) -> _Trial:
        """Try a method with each history, and choose its settings in some ways of holding out."""
        trials = []
        for history, readings in self.inputs.items():
            settings = choose_settings(method, readings, self.values, self.folds[ways], self.budget)
            predicted = cross_predict(method, settings, readings, self.values, self.folds, budget=self.budget)
            trials.append(_scored(predicted, self.values, settings, history))
        return min(trials, key=lambda trial: trial.error)


def _scored(predicted: np.ndarray, values: np.ndarray, settings: Settings = (), history: int = 0) -> _Trial:
    errors = [max(_root_mean_square(way - values), 1e-12) for way in predicted]
    return _Trial(settings, history, predicted, float(np.exp(np.mean(np.log(errors)))))


def _root_mean_square(errors: np.ndarray) -> float:
    """Compute the root mean square length of errors (..., d)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1))))


def _name_of(methods: Mapping[str, Any]) -> str:
    return "weighted methods" if len(methods) > 1 else next(iter(methods))


def _single(name: str, trial: _Trial) -> _Candidate:
    return _Candidate(trial, {name: trial}, {name: 1.0})


def _weighted(methods: dict[str, _Trial], trials: _Trials, ways: slice) -> _Candidate:
    """Find the weighted sum of methods with the smallest error in some ways of holding out.

    The weights for a fold come from the other folds.
    """
    values, predicted = trials.values, np.stack([trial.predicted for trial in methods.values()])
    row_folds, chosen = trials.folds[ways][0], predicted[:, ways]
    summed = np.empty(predicted.shape[1:])
    for fold in np.unique(row_folds):
        held_out = row_folds == fold
        shares, centre = _stack_weights(chosen[:, :, ~held_out], values[~held_out])
        summed[:, held_out] = centre + np.tensordot(shares, predicted[:, :, held_out] - centre, 1)
    shares = _stack_weights(chosen, values)[0]
    min_weight = HEAD_CONFIG.min_weight
    weights = {name: float(share) for name, share in zip(methods, shares, strict=True) if share > min_weight}
    if len(weights) < 2:
        name = min(methods, key=lambda name: methods[name].error)
        return _single(name, methods[name])
    return _Candidate(_scored(summed, values), methods, weights)


def _choose(best: list[dict[str, _Trial]], ways: list[slice], trials: _Trials, distance: np.ndarray) -> _Candidate:
    """Choose the candidate of smallest error: a single method, a weighted sum, or one of these for each of two ways."""
    values = trials.values
    singles = [[_single(name, methods[name]) for name in methods] for methods in best]
    candidates = [*chain(*singles), *(_weighted(methods, trials, slice(None)) for methods in best)]
    if len(best) > 1:
        of_blocks, of_presses = (
            [*of_way, _weighted(methods, trials, way)] for way, methods, of_way in zip(ways, best, singles, strict=True)
        )
        far = min(of_blocks, key=lambda candidate: _root_mean_square(candidate.trial.predicted[0] - values))
        for near, shares in product(of_presses, HEAD_CONFIG.gates):
            gate = np.array([np.quantile(distance[way], share) for way, share in zip((1, 0), shares, strict=True)])
            gate = np.maximum.accumulate(gate)
            blended = _blend(gate, distance, near.trial.predicted, far.trial.predicted)
            candidates.append(_Candidate(_scored(blended, values), far.methods, far.weights, near, gate))
    return min(candidates, key=lambda candidate: candidate.trial.error)


def _blend(gate: np.ndarray, distance: np.ndarray, near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Blend the prediction near known readings into the prediction far from them."""
    share = np.clip((distance - gate[0]) / max(gate[1] - gate[0], 1e-12), 0, 1)[..., None]
    return (1 - share) * near + share * far


def _stack_weights(predicted: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find weights >= 0 with the smallest squared error of the sum about the mean of the values (d,)."""
    centre, scale = values.mean(0), np.maximum(values.std(0), 1e-12)
    columns = ((predicted - centre) / scale).reshape(len(predicted), -1).T
    expected = np.broadcast_to((values - centre) / scale, predicted.shape[1:])
    return nnls(columns, expected.ravel())[0], centre


def _fit_stack(candidate: _Candidate, trials: _Trials) -> StackRecord:
    """Fit each method that has a weight to all rows."""
    fields = dict(zip(HEAD_METHODS, StackRecord._fields[-len(HEAD_METHODS) :], strict=True))
    methods = {name: candidate.methods[name] for name in candidate.weights}
    inputs, values, budget = trials.inputs, trials.values, trials.budget
    parts = {
        fields[name]: fit_regression(name, trial.settings, inputs[trial.history], values, budget=budget)
        for name, trial in methods.items()
    }
    return StackRecord(
        centre=trials.values.mean(0),
        weights=np.array([candidate.weights.get(name, 0.0) for name in HEAD_METHODS]),
        histories=np.array([methods[name].history if name in methods else 0 for name in HEAD_METHODS]),
        **parts,
    )


def _predict_stack(stack: StackRecord, inputs: np.ndarray, history: int) -> np.ndarray:
    """Predict with a weighted sum, from readings with `history` earlier rows."""
    deviation = np.zeros((len(inputs), len(stack.centre)))
    for name, part in stack.parts.items():
        i = HEAD_METHODS.index(name)
        used = inputs[:, : inputs.shape[1] * (1 + int(stack.histories[i])) // (1 + history)]
        deviation += stack.weights[i] * (predict_regression(part, used) - stack.centre)
    return stack.centre + deviation


def _fold_distances(readings: np.ndarray, folds: np.ndarray) -> np.ndarray:
    """Measure the distance of each reading from the nearest of other folds in features, `(ways, n)`."""
    x = make_feature_map(FeatureKind.PLAIN, readings)(readings)
    distance = np.empty(folds.shape)
    for way, row_folds in enumerate(folds):
        for fold in np.unique(row_folds):
            held_out = row_folds == fold
            distance[way, held_out] = nearest_known(x[~held_out], x[held_out], 1)[0][:, 0]
    return distance


def _fit_spread(readings: np.ndarray, errors: np.ndarray, groups: np.ndarray, distance: np.ndarray) -> SpreadRecord:
    """Fit the uncertainty to the errors `(ways, n, d)` on held-out folds of whole groups `(ways, n)`."""
    features = make_feature_map(FeatureKind.PLAIN, readings)
    x = features(readings)
    likeness = np.concatenate([_likeness(readings, of_way) for of_way in distance])
    flat_errors = errors.reshape(-1, errors.shape[-1])
    middle, width = likeness.mean(0), np.maximum(likeness.std(0), 1e-6)
    record = SpreadRecord(
        features=features,
        known=x[subsample(len(x), HeadBudget().known_rows)],
        likeness=(likeness - middle) / width,
        middle=middle,
        width=width,
        square=flat_errors**2,
        factor=np.ones(flat_errors.shape[1]),
        far=np.array(HEAD_CONFIG.unfamiliar_factor * np.quantile(distance, HEAD_CONFIG.unfamiliar_quantile)),
    )
    similar = _error_of_similar(record, record.likeness, leave_out_itself=True)
    ratio = (np.abs(flat_errors) / similar).reshape(errors.shape)
    # The way of holding out with the largest factor is usually that between known places.
    factor = np.max([_factor_of_groups(*way) for way in zip(ratio, groups, strict=True)], axis=0)
    return record._replace(factor=np.maximum(factor / STDS_WITHIN_90, 1e-3))


def _factor_of_groups(ratio: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Compute the factor (d,) above nine in ten of the ratios (n, d) in nine of ten groups, for one more group."""
    share = HEAD_CONFIG.range_share
    factors = np.array([np.quantile(ratio[group == number], share, axis=0) for number in np.unique(group)])
    return np.quantile(factors, min(share * (1 + 1 / len(factors)), 1.0), axis=0)


def _spread(record: SpreadRecord, readings: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Compute standard deviations (n, d) at a distance from the nearest known reading."""
    likeness = (_likeness(readings, distance) - record.middle) / record.width
    return _error_of_similar(record, likeness) * record.factor


def _likeness(readings: np.ndarray, distance: np.ndarray) -> np.ndarray:
    return np.column_stack([np.log(np.linalg.norm(readings, axis=1) + 1e-3), np.log(distance + 1e-6)])


def _error_of_similar(record: SpreadRecord, likeness: np.ndarray, *, leave_out_itself: bool = False) -> np.ndarray:
    """Compute the root mean square error of the most similar held-out rows."""
    n = len(record.likeness)
    k = min(max(HEAD_CONFIG.min_similar_rows, round(HEAD_CONFIG.similar_share * n)), n - 1)
    rows = cKDTree(record.likeness).query(likeness, k + leave_out_itself)[1].reshape(len(likeness), -1)
    square = np.mean(record.square[rows[:, int(leave_out_itself) :]], axis=1)
    return np.sqrt(square + 1e-6 * np.mean(record.square, axis=0) + 1e-18)
