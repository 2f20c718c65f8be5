"""Presets of the fidelity report."""

from dataclasses import dataclass, field

from i2t.heads.regression import HeadBudget


@dataclass(frozen=True)
class FidelityPreset:
    """Sizes of the report."""

    counts: tuple[int, ...] = (5, 10, 20, 50, 100, 300)  # calibration presses
    draws: int = 5  # random draws of calibration presses at each count
    test_rows: int = 1000  # largest test set of the calibration curves
    forward_rows: int = 1200  # largest training set of the Gaussian process over position and load
    block_mm: float = 6.0  # side of the square blocks that are held out
    held_out_share: float = 0.2  # fraction of the blocks, of the rows, or of the time
    try_causes: bool = True  # whether likely mistakes are undone and scored, not only the lag tested
    heads: HeadBudget = field(default_factory=HeadBudget)


FIDELITY_PRESETS: dict[str, FidelityPreset] = {
    "paper": FidelityPreset(),
    "short": FidelityPreset(
        counts=(5, 20, 100), draws=4, forward_rows=600,
        heads=HeadBudget(400, 1200, rows=4000),
    ),
    "debug": FidelityPreset(
        counts=(20,), draws=1, try_causes=False, test_rows=100, forward_rows=150,
        heads=HeadBudget(100, 200, rows=400),
    ),
}  # fmt: skip
