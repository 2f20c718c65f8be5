"""Readings from places and loads without any knowledge of skins: the model by which what repeats is separated from what
does not. NumPy and SciPy.
"""

from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from experiments.fidelity.sections import CannotTellError
from i2t.recordings.diagnose.smooth import leave_one_out
from i2t.recordings.presses import LoadedPresses, LoadName
from i2t.recordings.read import SkinRecording

SIMPLE_GP = "leave-one-out GP"
# Lengths (m), widths in standard deviations of the load, and noises as a share of a channel's variance.
GP_SETTINGS = ((8e-3, 4e-3, 2e-3, 16e-3, 32e-3), (1.0, 0.5, 2.0, 4.0), (1e-2, 1e-3, 1e-4, 1e-1))
GP_SELECTION_ROWS = 300
SMALLEST = 1e-9
RUNS_OF_ROWS = 20


def one_tip(recording: SkinRecording) -> None:
    """Raise CannotTellError where presses are of several objects."""
    if recording.labels is not None and len(np.unique(recording.labels)) > 1:
        raise CannotTellError(
            f"{len(np.unique(recording.labels))} objects touched the skin, and what a place and a load say of a "
            "reading holds for one tip only."
        )


def load_of(recording: SkinRecording) -> tuple[LoadName, np.ndarray]:
    """Name and values (n,) of the load: travel where it is known and varies, else force, else nothing (one load for
    all).
    """
    names: tuple[LoadName, ...] = ("travel", "force")
    for name in names:
        if recording.varies(name) and recording.known_rows(name).mean() > 0.5:
            return name, recording.targets[name][:, 0]
    if recording.varies("force"):
        return "force", recording.targets["force"][:, 0]
    return "none", np.zeros(len(recording))


def press_set(recording: SkinRecording, at_least: int = 10) -> LoadedPresses:
    """The presses of a recording from which readings can be predicted, or CannotTellError."""
    one_tip(recording)
    name, load = load_of(recording)
    good, position = np.isfinite(load), np.zeros((len(recording), 2))
    if recording.known_rows("position").any():
        good &= recording.known_rows("position")
        position = recording.targets["position"]
    if name == "none" and not recording.varies("position"):
        raise CannotTellError("Neither position nor load is known and varies, so that nothing predicts a reading.")
    if good.sum() < at_least:
        raise CannotTellError(f"Position and load are known of {good.sum()} rows; {at_least} are needed.")
    if not (np.ptp(recording.readings[good], axis=0) > 0).any():
        raise CannotTellError("No channel ever changes.")
    row = np.flatnonzero(good)
    return LoadedPresses(
        position[row], load[row], recording.readings[row], name, session=recording.session[row], row=row
    )


def simple_gp(presses: LoadedPresses, known: np.ndarray, test: np.ndarray) -> np.ndarray:
    """A GP over position and load, squared exponential in both, its three settings by leaving one out."""
    settings = choose_simple_gp(presses, known)
    x, y = presses.coordinates[known], presses.readings[known]
    middle, factor = y.mean(0), cho_factor(_covariance(settings, x), lower=True)
    return middle + _kernel(settings, presses.coordinates[test], x) @ cho_solve(factor, y - middle)


def choose_simple_gp(presses: LoadedPresses, known: np.ndarray) -> tuple[float, ...]:
    """Length (m), load width and noise with the least leave-one-out error."""
    some = known[:GP_SELECTION_ROWS]
    x, y = presses.coordinates[some], presses.readings[some]
    centred = y - y.mean(0)

    def error(settings: tuple[float, ...]) -> float:
        return float(np.sum(leave_one_out(_covariance(settings, x), centred).error ** 2))

    if len(some) <= GP_SELECTION_ROWS // 3:
        return min(product(*GP_SETTINGS), key=error)
    best = tuple(values[0] for values in GP_SETTINGS)
    for _ in range(2):
        for i, values in enumerate(GP_SETTINGS):
            best = min(((*best[:i], value, *best[i + 1 :]) for value in values), key=error)
    return best


def predicted_from_others(presses: LoadedPresses, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the set, at most so many in order of time, and their readings (n, c) as a GP of the others of them
    predicts each.
    """
    rows = np.random.default_rng(0).permutation(len(presses.load))[:limit]
    settings = choose_simple_gp(presses, rows)
    rows = np.sort(rows)
    y = presses.readings[rows]
    return rows, y - leave_one_out(_covariance(settings, presses.coordinates[rows]), y - y.mean(0)).error


def explained_share(readings: np.ndarray, predicted: np.ndarray) -> float:
    """R2 over all channels against the mean of the readings."""
    total = np.sum((readings - readings.mean(0)) ** 2)
    return float(1 - np.sum((readings - predicted) ** 2) / total) if total > 0 else float("nan")


def loses_beyond_chance(own: np.ndarray, other: np.ndarray) -> bool:
    """Test whether squared errors (n,) of one method are larger than another's on the same rows by more than chance.

    Rows that follow each other err alike, so that differences are summed over runs of rows: twice the standard error of
    these sums.
    """
    runs = np.array([part.sum() for part in np.array_split(own - other, min(RUNS_OF_ROWS, len(own)))])
    return bool(len(runs) > 2 and runs.mean() > 2 * runs.std(ddof=1) / np.sqrt(len(runs)))


def _covariance(settings: tuple[float, ...], x: np.ndarray) -> np.ndarray:
    return _kernel(settings, x, x) + (settings[2] + SMALLEST) * np.eye(len(x))


def _kernel(settings: tuple[float, ...], a: np.ndarray, b: np.ndarray) -> np.ndarray:
    length, width, _ = settings
    scaled = np.array([1 / length, 1 / length, 1 / width])
    a, b = a * scaled, b * scaled
    square = np.maximum(np.sum(a**2, 1)[:, None] + np.sum(b**2, 1)[None] - 2 * a @ b.T, 0)
    return np.exp(-square / 2)
