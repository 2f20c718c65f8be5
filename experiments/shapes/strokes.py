"""Recognition of strokes, which move over the skin during a series of samples, by the path of the contact.

The features do not depend on the ambient field, and little on the force and speed of a stroke:

  ambient        median of the stroke's own samples in each channel, valid if a channel rests half of the time
  saturation     v = b / (|b| + a) of the change b, whose direction depends on the position of the contact and whose
                 size depends on the force; a is a share of the root mean square of |b| over the training strokes
  time warping   squared distances of samples, summed along the best monotone alignment of two strokes (dynamic time
                 warping; Sakoe and Chiba, IEEE Transactions on Acoustics, Speech and Signal Processing 26, 1978)
  classifier     multinomial logistic regression on features of the kernel exp(-distance / median), by Nyström's method
                 with training strokes as landmarks (Williams and Seeger, NeurIPS 2000)
  augmentation   weaker and stronger copies of training strokes, and copies that are cut at either end

The path is v in the plane of its greatest variance: the contact's position up to a smooth map, which is unknown without
the positions of chips and magnets.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from sklearn.linear_model import LogisticRegression

MIN_NORM = 1e-9  # minimum divisor, for readings that never change


class StrokeSettings(NamedTuple):
    """Settings that are chosen on validation strokes."""

    saturation: float  # a as a share of the changes' root mean square
    penalty: float  # C of the logistic regression


def less_ambient(strokes: Float[np.ndarray, "n t d"]) -> Float[np.ndarray, "n t d"]:
    """Subtract each stroke's own ambient field.

    Args:
        strokes: Readings over time.

    Returns:
        Changes of the reading, `(n, t, d)`.
    """
    return strokes - ambient(strokes)[:, None]


def ambient(strokes: Float[np.ndarray, "n t d"]) -> Float[np.ndarray, "n d"]:
    """Estimate the reading at rest from each stroke's own samples.

    Args:
        strokes: Readings over time.

    Returns:
        The median over time, `(n, d)`.
    """
    return np.median(strokes, axis=1)


def quietest(strokes: Float[np.ndarray, "n t d"], share: float = 0.2) -> Float[np.ndarray, "n q d"]:
    """Select the samples of each stroke with little or no contact.

    Args:
        strokes: Readings over time.
        share: Share of the samples to select. A stroke rests for half of its samples.

    Returns:
        The q samples nearest to the stroke's `ambient`, at least two, in chronological order.
    """
    count = max(round(share * strokes.shape[1]), 2)
    size = np.linalg.norm(less_ambient(strokes), axis=-1)
    rows = np.sort(np.argsort(size, axis=1, kind="stable")[:, :count], axis=1)
    return np.take_along_axis(strokes, rows[:, :, None], axis=1)


def saturated(
    changes: Float[np.ndarray, "v n t d"], train: Int[np.ndarray, " m"], share: float
) -> Float[np.ndarray, "v n t d"]:
    """Compute the directions of the changes, with shorter vectors for small changes.

    Args:
        changes: Changes of strokes and their variations, from `varied`.
        train: Rows of the training strokes, whose unvaried changes set the scale.
        share: The setting `StrokeSettings.saturation`.

    Returns:
        Vectors of length below 1, `(v, n, t, d)`.
    """
    size = np.linalg.norm(changes, axis=-1, keepdims=True)
    return changes / (size + max(share * float(np.sqrt(np.mean(size[0, train] ** 2))), MIN_NORM))


def warped_distances(a: Float[np.ndarray, "n t d"], b: Float[np.ndarray, "m t d"]) -> Float[np.ndarray, "n m"]:
    """Compute distances of strokes after the best alignment of their times.

    With costs c of pairs of samples and their row sums s, the recursion of a row is D_j = c_j + min(p_j, D_(j-1)),
    where p is the lesser of the neighbours above; it unrolls to s_j + min over k <= j of (p_k - s_(k-1)).

    Args:
        a: Strokes.
        b: Other strokes.

    Returns:
        Sums of squared distances along each alignment, `(n, m)`.
    """
    distances = np.empty((len(a), len(b)))
    squared = (a**2).sum(-1)
    for column, stroke in enumerate(b):
        cost = np.maximum(squared[:, :, None] + (stroke**2).sum(-1) - 2 * a @ stroke.T, 0)
        reached = np.cumsum(cost[:, 0], axis=1)
        for row in range(1, cost.shape[1]):
            above = np.minimum(reached, np.pad(reached[:, :-1], ((0, 0), (1, 0)), constant_values=np.inf))
            sums = np.cumsum(cost[:, row], axis=1)
            reached = sums + np.minimum.accumulate(above - (sums - cost[:, row]), axis=1)
        distances[:, column] = reached[:, -1]
    return distances


def varied(
    changes: Float[np.ndarray, "n t d"], *, gains: Sequence[float] = (0.6, 1.6), cut_share: float = 0.2
) -> Float[np.ndarray, "v n t d"]:
    """Vary strokes by gains, and by shifts that cut off a part at either end.

    Args:
        changes: Changes of the reading, from `less_ambient`.
        gains: Factors of the weaker and stronger copies.
        cut_share: Share of the samples that is cut off.

    Returns:
        The unvaried strokes, then the variations, `(v, n, t, d)`.
    """
    cut = max(round(cut_share * changes.shape[1]), 1)
    late, early = (np.pad(changes, ((0, 0), pad, (0, 0))) for pad in ((cut, 0), (0, cut)))
    return np.stack([changes, *(gain * changes for gain in gains), late[:, :-cut], early[:, cut:]])


def choose_landmarks(train: Int[np.ndarray, " k"], most: int = 300) -> Int[np.ndarray, " m"]:
    """Choose evenly spaced training rows as landmarks.

    Args:
        train: Training rows.
        most: Maximum number of landmarks.

    Returns:
        The chosen rows, `(m,)`.
    """
    return train[np.unique(np.linspace(0, len(train) - 1, min(len(train), most)).round().astype(int))]


class StrokeKernel(NamedTuple):
    """Distances by which strokes are classified."""

    distances: Float[np.ndarray, "v n m"]  # from all strokes and their variations to the landmarks
    landmarks: Int[np.ndarray, " m"]  # rows of the landmarks


def stroke_kernel(vectors: Float[np.ndarray, "v n t d"], landmarks: Int[np.ndarray, " m"]) -> StrokeKernel:
    """Compute the distances of strokes and their variations to landmarks.

    Args:
        vectors: Saturated vectors of varied strokes.
        landmarks: Rows of the landmarks.

    Returns:
        The distances with the landmarks.
    """
    flat = vectors.reshape(-1, *vectors.shape[2:])
    distances = warped_distances(flat, vectors[0, landmarks])
    return StrokeKernel(distances.reshape(*vectors.shape[:2], -1), landmarks)


def classify(
    kernel: StrokeKernel, label: Int[np.ndarray, " n"], train: Int[np.ndarray, " k"], test: Int[np.ndarray, " q"],
    penalty: float,
) -> Float[np.ndarray, "q classes"]:  # fmt: skip
    """Predict the labels of strokes by logistic regression on kernel features.

    Args:
        kernel: Distances of all strokes.
        label: Label of each row. The training rows have all labels.
        train: Training rows, which are used with their variations. Other landmarks are left out.
        test: Rows to classify.
        penalty: C of the logistic regression.

    Returns:
        Probabilities of the labels, `(q, classes)`.
    """
    kept = np.isin(kernel.landmarks, train)
    distances, landmarks = kernel.distances[:, :, kept], kernel.landmarks[kept]
    similar = np.exp(-distances / max(float(np.median(distances[0, train])), MIN_NORM))
    values, vectors = np.linalg.eigh(similar[0, landmarks])
    good = values > 1e-6  # smaller eigenvalues are rounding errors
    features = similar @ (vectors[:, good] / np.sqrt(values[good]))
    learned = features[:, train].reshape(-1, features.shape[-1])
    fitted = LogisticRegression(C=penalty, max_iter=1000).fit(learned, np.tile(label[train], len(features)))
    return fitted.predict_proba(features[0, test])


# --- paths ---


def plane_paths(vectors: Float[np.ndarray, "v n t d"], train: Int[np.ndarray, " m"]) -> Float[np.ndarray, "v n t p"]:
    """Project strokes to the plane of the greatest variance of the training strokes.

    Args:
        vectors: Saturated vectors.
        train: Training rows.

    Returns:
        Two coordinates of every sample, `(v, n, t, 2)`, without unit, or one if a sample has one value.
    """
    axes = np.linalg.svd(vectors[0, train].reshape(-1, vectors.shape[-1]), full_matrices=False)[2]
    return vectors @ axes[:2].T


def mean_paths(
    paths: Float[np.ndarray, "n t p"], label: Int[np.ndarray, " n"], classes: int, points: int = 24
) -> Float[np.ndarray, "classes k p"]:
    """Average the paths of every label after resampling them at equal steps of their length.

    Args:
        paths: Paths of strokes.
        label: Label of each stroke.
        classes: Number of labels.
        points: Number of points of a resampled path.

    Returns:
        The mean path of each label, `(classes, points, p)`.
    """
    steps = np.linalg.norm(np.diff(paths, axis=1), axis=-1)
    length = np.concatenate([np.zeros((len(paths), 1)), np.cumsum(steps, axis=1)], axis=1)
    even = [
        np.stack([np.interp(np.linspace(0, s[-1], points), s, x) for x in path.T], -1)
        for s, path in zip(length, paths, strict=True)
    ]
    return np.stack([np.mean(np.array(even)[label == i], axis=0) for i in range(classes)])
