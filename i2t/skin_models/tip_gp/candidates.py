"""Candidate boards of a skin whose board is unknown: named boards with the same number of chips, in four rotations.

A chip is near the positions where it has a large share of the readings' power. The mean of the presses' positions,
weighted by these shares, estimates where each chip lies, and boards are ranked by how well these estimates match their
chips. The best few are candidates; leave-one-out errors decide between them (`i2t.skin_models.tip_gp.population`).
"""

import numpy as np
from jaxtyping import Float

from i2t.skin.boards import AXES_OF_CHIP, BOARDS


def board_candidates(
    positions: Float[np.ndarray, "n 2"], readings: Float[np.ndarray, "n c"], *, limit: int = 2
) -> dict[str, Float[np.ndarray, "chips 2"]]:
    """List the boards, with their rotations, that best match the places where each chip of a skin reads most.

    Args:
        positions: `(n, 2)` positions of the presses (m).
        readings: `(n, c)` readings of the presses (uT).
        limit: Maximum number of boards.

    Returns:
        Chip positions `(chips, 2)` (m) of at most `limit` boards by name, the best first. There are none if no named
        board has this number of chips, or if the presses do not show where the chips are.
    """
    chips = readings.shape[1] // AXES_OF_CHIP
    if readings.shape[1] % AXES_OF_CHIP or len(positions) < 3 or not np.ptp(positions, axis=0).all():
        return {}
    boards = _named_boards(chips)
    fit = {name: _fit(positions, readings, at) for name, at in boards.items()}
    best = sorted((name for name in boards if fit[name] > 0), key=lambda name: -fit[name])
    return {name: boards[name] for name in best[:limit]}


def _named_boards(chips: int) -> dict[str, np.ndarray]:
    """List the chip positions of the named boards in four rotations, without duplicates (within 1 um)."""
    quarter_turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    boards: dict[str, np.ndarray] = {}
    for name, make in BOARDS.items():
        at = np.asarray(make().chips[:, :2], np.float64)
        for quarters in range(4) if len(at) == chips else ():
            turned = at @ np.linalg.matrix_power(quarter_turn, quarters).T
            if not any(np.abs(turned - other).max() < 1e-6 for other in boards.values()):
                boards[f"{name} turned by {90 * quarters} degrees" if quarters else name] = turned
    return boards


def _fit(positions: np.ndarray, readings: np.ndarray, chips: np.ndarray) -> float:
    """Correlate the chip positions with the estimates from the chips' shares of the readings' power."""
    power = (readings.reshape(len(readings), len(chips), AXES_OF_CHIP) ** 2).sum(2)
    share = power / np.maximum(power.sum(1, keepdims=True), 1e-12)
    centre = share.T @ (positions - positions.mean(0)) / np.maximum(share.sum(0), 1e-12)[:, None]
    centre, offset = centre - centre.mean(0), chips - chips.mean(0)
    size = np.sqrt((centre**2).sum() * (offset**2).sum())
    return float((centre * offset).sum() / size) if size > 0 else 0.0
