"""A Gaussian process from position and load to readings, which separates repeatable from unrepeatable changes.

It uses no model of the skin, and only NumPy and SciPy.
"""

from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from experiments.fidelity.sections import CannotTellError
from i2t.recordings.diagnose.smooth import leave_one_out
from i2t.recordings.presses import LoadedPresses, LoadName
from i2t.recordings.read import SkinRecording

SIMPLE_GP = "leave-one-out GP"
# Candidate length scales (m), load widths (standard deviations of the load) and noises (fractions of the variance).
GP_SETTINGS = ((8e-3, 4e-3, 2e-3, 16e-3, 32e-3), (1.0, 0.5, 2.0, 4.0), (1e-2, 1e-3, 1e-4, 1e-1))
GP_SELECTION_ROWS = 300


def one_tip(recording: SkinRecording) -> None:
    """Raise `CannotTellError` if several objects touched the skin."""
    if recording.labels is not None and len(np.unique(recording.labels)) > 1:
        raise CannotTellError(
            f"{len(np.unique(recording.labels))} objects touched the skin, but position and load predict a "
            "reading for one tip only."
        )


def load_of(recording: SkinRecording) -> tuple[LoadName, np.ndarray]:
    """Choose the load of a recording: its travel if it varies and most rows have it, else its force, else none.

    Args:
        recording: A recording of one skin.

    Returns:
        The name of the load, and its values `(n,)` in metres or newtons, which are zero if there is none.
    """
    names: tuple[LoadName, ...] = ("travel", "force")
    for name in names:
        if recording.varies(name) and recording.known_rows(name).mean() > 0.5:
            return name, recording.targets[name][:, 0]
    if recording.varies("force"):
        return "force", recording.targets["force"][:, 0]
    return "none", np.zeros(len(recording))


def press_set(recording: SkinRecording, at_least: int = 10) -> LoadedPresses:
    """Select the presses with known position and load, or raise `CannotTellError` if they predict no reading."""
    one_tip(recording)
    name, load = load_of(recording)
    good, position = np.isfinite(load), np.zeros((len(recording), 2))
    if recording.known_rows("position").any():
        good &= recording.known_rows("position")
        position = recording.targets["position"]
    if name == "none" and not recording.varies("position"):
        raise CannotTellError("Neither position nor load is known and varies, so nothing predicts a reading.")
    if good.sum() < at_least:
        raise CannotTellError(f"Position and load are known in {good.sum()} rows; {at_least} are needed.")
    if not (np.ptp(recording.readings[good], axis=0) > 0).any():
        raise CannotTellError("No channel ever changes.")
    row = np.flatnonzero(good)
    return LoadedPresses(
        position[row], load[row], recording.readings[row], name, session=recording.session[row], row=row
    )


def simple_gp(presses: LoadedPresses, train: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Predict test readings `(m, c)` by a squared-exponential GP over position and load; settings by leave-one-out."""
    settings = choose_simple_gp(presses, train)
    x, y = presses.coordinates[train], presses.readings[train]
    middle, factor = y.mean(0), cho_factor(_covariance(settings, x), lower=True)
    return middle + _kernel(settings, presses.coordinates[test], x) @ cho_solve(factor, y - middle)


def choose_simple_gp(presses: LoadedPresses, train: np.ndarray) -> tuple[float, ...]:
    """Choose the length scale (m), load width and noise with the smallest leave-one-out error."""
    subset = train[:GP_SELECTION_ROWS]
    x, y = presses.coordinates[subset], presses.readings[subset]
    centred = y - y.mean(0)

    def error(settings: tuple[float, ...]) -> float:
        return float(np.sum(leave_one_out(_covariance(settings, x), centred).error ** 2))

    if len(subset) <= GP_SELECTION_ROWS // 3:
        return min(product(*GP_SETTINGS), key=error)
    best = tuple(values[0] for values in GP_SETTINGS)
    for _ in range(2):
        for i, values in enumerate(GP_SETTINGS):
            best = min(((*best[:i], value, *best[i + 1 :]) for value in values), key=error)
    return best


def predicted_from_others(presses: LoadedPresses, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Predict readings by leave-one-out with the Gaussian process.

    Args:
        presses: Presses in the order of time.
        limit: Largest number of presses used; more are sampled at random.

    Returns:
        Indices `(n,)` of the presses used, in order of time, and their predicted readings `(n, c)` in microtesla.
    """
    rows = np.random.default_rng(0).permutation(len(presses.load))[:limit]
    settings = choose_simple_gp(presses, rows)
    rows = np.sort(rows)
    y = presses.readings[rows]
    return rows, y - leave_one_out(_covariance(settings, presses.coordinates[rows]), y - y.mean(0)).error


def explained_share(readings: np.ndarray, predicted: np.ndarray) -> float:
    """R2 over all channels, relative to the mean reading."""
    total = np.sum((readings - readings.mean(0)) ** 2)
    return float(1 - np.sum((readings - predicted) ** 2) / total) if total > 0 else float("nan")


def loses_beyond_chance(own: np.ndarray, other: np.ndarray) -> bool:
    """Test whether squared errors (n,) of one method are larger than another's on the same rows by more than chance.

    Consecutive rows have correlated errors, so differences are summed over up to 20 runs of rows; the mean of the sums
    must exceed twice its standard error.
    """
    runs = np.array([part.sum() for part in np.array_split(own - other, min(20, len(own)))])
    return bool(len(runs) > 2 and runs.mean() > 2 * runs.std(ddof=1) / np.sqrt(len(runs)))


def _covariance(settings: tuple[float, ...], x: np.ndarray) -> np.ndarray:
    return _kernel(settings, x, x) + (settings[2] + 1e-9) * np.eye(len(x))


def _kernel(settings: tuple[float, ...], a: np.ndarray, b: np.ndarray) -> np.ndarray:
    length, width, _ = settings
    scaled = np.array([1 / length, 1 / length, 1 / width])
    a, b = a * scaled, b * scaled
    square = np.maximum(np.sum(a**2, 1)[:, None] + np.sum(b**2, 1)[None] - 2 * a @ b.T, 0)
    return np.exp(-square / 2)
