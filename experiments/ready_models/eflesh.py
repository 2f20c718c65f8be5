"""A small calibration of a real skin: fitted to presses of one eFlesh session, and holding none of them.

A structured Gaussian process conditioned on many presses (the teacher) predicts readings on a grid of places and
depths, and a small one is conditioned on these predictions. So the file has the size of the grid, and no recorded row
is in it. The widths of its intervals are measured on presses of their own. All is judged at places that neither the
teacher nor the widths have seen: a fifth of all, drawn once.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from i2t.calibration import DEPTH_HYPERPARAMETERS, Calibration, calibrate
from i2t.convert import eflesh
from i2t.prediction.metrics import score

TEST_SHARE = 0.2  # of the places
TEACHER_PRESSES, INTERVAL_PRESSES = 1000, 500
GRID_PLACES, GRID_DEPTHS = 10, 3  # along an edge of the skin, and at each place
PLACE_DECIMALS = 4  # m: places that differ by less are one
RANGE_STDS, RANGE_SHARE = 1.645, 0.9  # of a normal distribution
BASELINE_PRESSES = 20
BASELINE_NEIGHBOURS = 3
MM_PER_M = 1e3


class RecordedSession(NamedTuple):
    """Presses in the skin, in the order of time."""

    position: np.ndarray  # (n, 2) m
    depth: np.ndarray  # (n,) m
    reading: np.ndarray  # (n, c) uT
    notes: tuple[str, ...]
    name: str

    def some(self, rows: np.ndarray) -> "RecordedSession":
        """Some of the presses."""
        return self._replace(position=self.position[rows], depth=self.depth[rows], reading=self.reading[rows])


def read_session(folder: Path) -> RecordedSession:
    """The presses of a session of eFlesh.

    Args:
        folder: Of the session.

    Returns:
        Those deeper than first contact.
    """
    converted = eflesh.convert(folder)
    touches = converted.dataset.touches
    rows = np.flatnonzero(touches.depth > 0)
    place = touches.T_w_o[rows, :2, 3].astype(np.float64)
    return RecordedSession(place, touches.depth[rows], touches.reading[rows], converted.notes, folder.name)


def fit_small(session: RecordedSession, seed: int) -> tuple[Calibration, dict[str, Any]]:
    """A small calibration of a session, and its card.

    Args:
        session: All presses.
        seed: Of what is drawn.

    Returns:
        The calibration, and what it was made of and how well it predicts presses at places it has not seen.
    """
    rng = np.random.default_rng(seed)
    places, place_of = np.unique(np.round(session.position, PLACE_DECIMALS), axis=0, return_inverse=True)
    chosen = rng.permutation(len(places))[: round(TEST_SHARE * len(places))]
    held_out = np.isin(place_of.ravel(), chosen)
    known = rng.permutation(np.flatnonzero(~held_out))
    fitted_to = session.some(known[:TEACHER_PRESSES])
    for_intervals = session.some(known[TEACHER_PRESSES:][:INTERVAL_PRESSES])
    test = session.some(np.flatnonzero(held_out))
    teacher = _calibrated(fitted_to.position, fitted_to.depth, fitted_to.reading)
    grid = _grid(session)
    small = _calibrated(grid[:, :2], grid[:, 2], teacher.predict(grid[:, :2], grid[:, 2])[0])
    small = replace(small, interval_scaling=jnp.float32(_interval_scaling(small, for_intervals)))
    few = session.some(known[:BASELINE_PRESSES])
    card = {
        "source": "real",
        "recording": f"eFlesh, characterization/datasets/spatial/{session.name}",
        "licence": "MIT, Copyright (c) 2025 Venkatesh Pattabiraman",
        "presses": {"teacher": TEACHER_PRESSES, "intervals": INTERVAL_PRESSES, "test": len(test.depth)},
        "places": {"all": len(places), "test": len(chosen)},
        "grid": len(grid),
        "range_mm": {
            "x": _range(session.position[:, 0]), "y": _range(session.position[:, 1]), "depth": _range(session.depth)
        },
        "methods": {
            "small calibration": _judged(small, test),
            "its teacher, 1000 presses": _judged(teacher, test),
            f"i2t.calibrate, {BASELINE_PRESSES} presses": _judged(
                calibrate(few.position, few.depth, few.reading, load_kind="depth"), test
            ),
            f"mean of {BASELINE_NEIGHBOURS} nearest of the 1000": _scores(test, _nearest(fitted_to, test)),
            "mean reading": _scores(test, np.tile(fitted_to.reading.mean(0), (len(test.depth), 1))),
        },
    }  # fmt: skip
    about = {key: card[key] for key in ("source", "recording", "licence")} | {"notes": list(session.notes)}
    return replace(small, metadata=about), card


def _calibrated(position: np.ndarray, depth: np.ndarray, reading: np.ndarray) -> Calibration:
    return calibrate(position, depth, reading, load_kind="depth", hyperparameters=DEPTH_HYPERPARAMETERS)


def _grid(session: RecordedSession) -> np.ndarray:
    """Places and depths (n, 3) m in random order, as the Gaussian process wants its presses."""
    edges = [np.linspace(column.min(), column.max(), GRID_PLACES) for column in session.position.T]
    depths = np.quantile(session.depth, np.linspace(0, 1, GRID_DEPTHS))
    grid = np.stack(np.meshgrid(*edges, depths, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.random.default_rng(0).permutation(grid)


def _interval_scaling(calibration: Calibration, presses: RecordedSession) -> np.ndarray:
    """Factors of each channel's deviations with which nine in ten readings lie in the 90 % range."""
    mean, std = calibration.predict(presses.position, presses.depth)
    away = np.quantile(np.abs(presses.reading - mean) / std, RANGE_SHARE, axis=0) / RANGE_STDS
    return np.asarray(calibration.interval_scaling) * away


def _judged(calibration: Calibration, test: RecordedSession) -> dict[str, float]:
    mean, std = calibration.predict(test.position, test.depth)
    inside = float(np.mean(np.abs(test.reading - mean) < RANGE_STDS * std))
    return _scores(test, mean) | {"coverage_90": inside}


def _scores(test: RecordedSession, mean: np.ndarray) -> dict[str, float]:
    found = score(test.reading, mean)
    return {"r2": float(found.r2), "rmse": float(np.sqrt(np.mean((test.reading - mean) ** 2)))}


def _nearest(known: RecordedSession, test: RecordedSession) -> np.ndarray:
    """Mean reading of the nearest presses, places and depths in their standard deviations."""
    features = [np.column_stack([part.position, part.depth]) for part in (known, test)]
    unit = features[0].std(0)
    away = np.linalg.norm((features[1][:, None] - features[0][None]) / unit, axis=2)
    return known.reading[np.argsort(away, axis=1)[:, :BASELINE_NEIGHBOURS]].mean(1)


def _range(values: np.ndarray) -> list[float]:
    return [round(MM_PER_M * float(values.min()), 2), round(MM_PER_M * float(values.max()), 2)]
