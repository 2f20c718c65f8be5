"""Recognition of strokes, touches that move over the skin while it is sampled, by the path of the contact.

What a stroke is told by shall not depend on the field around it, on how hard or how quickly it was made:

  ambient        median of the stroke's own samples, channel by channel: right while a channel rests half of the time
  saturation     v = b / (|b| + a) of the change b: its direction says where the contact is, its size how hard; a is a
                 share of the root mean square of |b| over the training strokes
  time warping   squared distances of samples, summed along the best monotone alignment of two strokes (dynamic time
                 warping; Sakoe and Chiba, IEEE Transactions on Acoustics, Speech and Signal Processing 26, 1978)
  classifier     multinomial logistic regression on the features of the kernel exp(-distance / median) (Nyström's, of
                 at most `MAX_LANDMARKS` training strokes; Williams and Seeger, NeurIPS 2000)
  augmentation   training strokes also weaker, stronger, and cut at either end, as windows cut them

The path is v in the plane in which it varies most: the contact's position up to an unknown smooth map, because where a
skin reads what is not known without its chips and magnets.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from sklearn.linear_model import LogisticRegression

MAX_LANDMARKS = 300
GAINS = (0.6, 1.6)  # of training strokes made weaker and stronger
CUT = 0.2  # share of a window by which training strokes are moved out of it
PATH_POINTS = 24  # of a resampled path
QUIET_SHARE = 0.2  # of a stroke's samples, the quietest: a stroke rests for half of its window
PLANE = 2
MIN_EIGENVALUE = 1e-6  # of the landmarks' kernel: less is rounding
MIN_NORM = 1e-9  # of readings that never change


class StrokeSettings(NamedTuple):
    """What validation chooses."""

    saturation: float  # a, as a share of the changes' root mean square
    penalty: float  # C of the logistic regression


def less_ambient(strokes: Float[np.ndarray, "n t d"]) -> Float[np.ndarray, "n t d"]:
    """Changes of the reading: strokes without each one's own ambient field.

    Args:
        strokes: Readings over time.

    Returns:
        The same less `ambient`.
    """
    return strokes - ambient(strokes)[:, None]


def ambient(strokes: Float[np.ndarray, "n t d"]) -> Float[np.ndarray, "n d"]:
    """Reading of the skin at rest around each stroke, from its own samples.

    Args:
        strokes: Readings over time.

    Returns:
        The median over time.
    """
    return np.median(strokes, axis=1)


def quietest(strokes: Float[np.ndarray, "n t d"]) -> Float[np.ndarray, "n q d"]:
    """Samples of each stroke in which nothing is felt, or next to nothing.

    Args:
        strokes: Readings over time.

    Returns:
        The q samples nearest to the stroke's `ambient`, at least two, in order of time.
    """
    count = max(round(QUIET_SHARE * strokes.shape[1]), 2)
    size = np.linalg.norm(less_ambient(strokes), axis=-1)
    rows = np.sort(np.argsort(size, axis=1, kind="stable")[:, :count], axis=1)
    return np.take_along_axis(strokes, rows[:, :, None], axis=1)


def saturated(
    changes: Float[np.ndarray, "v n t d"], train: Int[np.ndarray, " m"], share: float
) -> Float[np.ndarray, "v n t d"]:
    """Directions of the changes, shorter where these are small.

    Args:
        changes: As of `varied`.
        train: Rows from which the scale is taken, as they are.
        share: `StrokeSettings.saturation`.

    Returns:
        Vectors of length below 1.
    """
    size = np.linalg.norm(changes, axis=-1, keepdims=True)
    return changes / (size + max(share * float(np.sqrt(np.mean(size[0, train] ** 2))), MIN_NORM))


def warped_distances(a: Float[np.ndarray, "n t d"], b: Float[np.ndarray, "m t d"]) -> Float[np.ndarray, "n m"]:
    """Distances of strokes after the best alignment of their times.

    With costs c of pairs of samples and their row sums s, the recursion of a row is D_j = c_j + min(p_j, D_(j-1)),
    where p is the lesser of its neighbours above; it unrolls to s_j + min over k <= j of (p_k - s_(k-1)).

    Args:
        a: Strokes.
        b: Others.

    Returns:
        Sums of squared distances along each alignment.
    """
    found = np.empty((len(a), len(b)))
    squared = (a**2).sum(-1)
    for column, stroke in enumerate(b):
        cost = np.maximum(squared[:, :, None] + (stroke**2).sum(-1) - 2 * a @ stroke.T, 0)
        reached = np.cumsum(cost[:, 0], axis=1)
        for row in range(1, cost.shape[1]):
            above = np.minimum(reached, np.pad(reached[:, :-1], ((0, 0), (1, 0)), constant_values=np.inf))
            sums = np.cumsum(cost[:, row], axis=1)
            reached = sums + np.minimum.accumulate(above - (sums - cost[:, row]), axis=1)
        found[:, column] = reached[:, -1]
    return found


def varied(changes: Float[np.ndarray, "n t d"]) -> Float[np.ndarray, "v n t d"]:
    """Strokes as they are, with other gains, and moved to either end of their windows until a part is cut off.

    Args:
        changes: As of `less_ambient`: a skin at rest reads 0.

    Returns:
        The same first, then its variations.
    """
    cut = max(round(CUT * changes.shape[1]), 1)
    late, early = (np.pad(changes, ((0, 0), pad, (0, 0))) for pad in ((cut, 0), (0, cut)))
    return np.stack([changes, *(gain * changes for gain in GAINS), late[:, :-cut], early[:, cut:]])


def choose_landmarks(train: Int[np.ndarray, " k"]) -> Int[np.ndarray, " m"]:
    """At most `MAX_LANDMARKS` of the training rows, evenly over them.

    Args:
        train: Rows.

    Returns:
        Some of them.
    """
    return train[np.unique(np.linspace(0, len(train) - 1, min(len(train), MAX_LANDMARKS)).round().astype(int))]


class StrokeKernel(NamedTuple):
    """Distances from which strokes are classified."""

    distances: Float[np.ndarray, "v n m"]  # of all strokes and their variations to the landmarks
    landmarks: Int[np.ndarray, " m"]  # rows


def stroke_kernel(vectors: Float[np.ndarray, "v n t d"], landmarks: Int[np.ndarray, " m"]) -> StrokeKernel:
    """Distances of strokes and their variations to landmarks.

    Args:
        vectors: As of `saturated`, of `varied` strokes.
        landmarks: Rows.

    Returns:
        The distances.
    """
    flat = vectors.reshape(-1, *vectors.shape[2:])
    found = warped_distances(flat, vectors[0, landmarks])
    return StrokeKernel(found.reshape(*vectors.shape[:2], -1), landmarks)


def classify(
    kernel: StrokeKernel, label: Int[np.ndarray, " n"], train: Int[np.ndarray, " k"], test: Int[np.ndarray, " q"],
    penalty: float,
) -> Float[np.ndarray, "q classes"]:  # fmt: skip
    """Probabilities of every label, by logistic regression on kernel features.

    Args:
        kernel: Of all strokes.
        label: Of all rows; every label is among those of `train`.
        train: Rows to learn from, with their variations; landmarks that are none of them are left out.
        test: Rows to classify.
        penalty: C of the logistic regression.

    Returns:
        Probabilities.
    """
    kept = np.isin(kernel.landmarks, train)
    distances, landmarks = kernel.distances[:, :, kept], kernel.landmarks[kept]
    similar = np.exp(-distances / max(float(np.median(distances[0, train])), MIN_NORM))
    values, vectors = np.linalg.eigh(similar[0, landmarks])
    good = values > MIN_EIGENVALUE
    features = similar @ (vectors[:, good] / np.sqrt(values[good]))
    learned = features[:, train].reshape(-1, features.shape[-1])
    fitted = LogisticRegression(C=penalty, max_iter=1000).fit(learned, np.tile(label[train], len(features)))
    return fitted.predict_proba(features[0, test])


# --- paths ---


def plane_paths(vectors: Float[np.ndarray, "v n t d"], train: Int[np.ndarray, " m"]) -> Float[np.ndarray, "v n t p"]:
    """Paths of strokes in the plane in which the training strokes vary most.

    Args:
        vectors: As of `saturated`.
        train: Rows from which the plane is taken.

    Returns:
        Two coordinates of every sample, without unit; one where a sample has one value.
    """
    axes = np.linalg.svd(vectors[0, train].reshape(-1, vectors.shape[-1]), full_matrices=False)[2]
    return vectors @ axes[:PLANE].T


def mean_paths(
    paths: Float[np.ndarray, "n t p"], label: Int[np.ndarray, " n"], classes: int
) -> Float[np.ndarray, "classes k p"]:
    """Mean path of every label, each resampled at equal steps of its length.

    Args:
        paths: Of strokes.
        label: Of each.
        classes: Number of labels.

    Returns:
        `PATH_POINTS` points of each label.
    """
    steps = np.linalg.norm(np.diff(paths, axis=1), axis=-1)
    length = np.concatenate([np.zeros((len(paths), 1)), np.cumsum(steps, axis=1)], axis=1)
    even = [
        np.stack([np.interp(np.linspace(0, s[-1], PATH_POINTS), s, x) for x in path.T], -1)
        for s, path in zip(length, paths, strict=True)
    ]
    return np.stack([np.mean(np.array(even)[label == i], axis=0) for i in range(classes)])
