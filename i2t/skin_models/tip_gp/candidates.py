"""Candidate boards of a skin whose board is unknown: the named ones of as many chips, in four turns each.

Where a chip has its largest share of the readings' power, it lies: the presses' positions weighted by these shares have
a centre for each chip, and boards are ranked by how well these centres lie as their chips do. The few that fit best are
candidates. Which of them it is, or none, is for what presses left out say (`i2t.skin_models.tip_gp.population`).
"""

import numpy as np
from jaxtyping import Float

from i2t.skin.boards import AXES_OF_CHIP, BOARDS

MAX_CANDIDATE_BOARDS = 2
MIN_RANKED_PRESSES = 3
QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
SAME_M = 1e-6  # chips that differ by less are in one place


def board_candidates(
    positions: Float[np.ndarray, "n 2"], readings: Float[np.ndarray, "n c"]
) -> dict[str, Float[np.ndarray, "chips 2"]]:
    """Boards that best fit the places where each chip reads most.

    Args:
        positions: Of the presses (m).
        readings: Of the presses (uT).

    Returns:
        Positions of the chips (m) of at most MAX_CANDIDATE_BOARDS boards by name, the best first; none where no board
        of a name has as many chips, or presses say nothing of where chips are.
    """
    chips = readings.shape[1] // AXES_OF_CHIP
    if readings.shape[1] % AXES_OF_CHIP or len(positions) < MIN_RANKED_PRESSES or not np.ptp(positions, axis=0).all():
        return {}
    found = _named_boards(chips)
    fit = {name: _fit(positions, readings, at) for name, at in found.items()}
    best = sorted((name for name in found if fit[name] > 0), key=lambda name: -fit[name])
    return {name: found[name] for name in best[:MAX_CANDIDATE_BOARDS]}


def _named_boards(chips: int) -> dict[str, np.ndarray]:
    """Chip positions of named boards in four turns; equal ones are left out."""
    found: dict[str, np.ndarray] = {}
    for name, make in BOARDS.items():
        at = np.asarray(make().chips[:, :2], np.float64)
        for quarters in range(4) if len(at) == chips else ():
            turned = at @ np.linalg.matrix_power(QUARTER_TURN, quarters).T
            if not any(np.abs(turned - other).max() < SAME_M for other in found.values()):
                found[f"{name} turned by {90 * quarters} degrees" if quarters else name] = turned
    return found


def _fit(positions: np.ndarray, readings: np.ndarray, chips: np.ndarray) -> float:
    """Correlation of chip positions with the centres of their share of the readings' power."""
    power = (readings.reshape(len(readings), len(chips), AXES_OF_CHIP) ** 2).sum(2)
    share = power / np.maximum(power.sum(1, keepdims=True), 1e-12)
    centre = share.T @ (positions - positions.mean(0)) / np.maximum(share.sum(0), 1e-12)[:, None]
    centre, lie = centre - centre.mean(0), chips - chips.mean(0)
    size = np.sqrt((centre**2).sum() * (lie**2).sum())
    return float((centre * lie).sum() / size) if size > 0 else 0.0
