"""Presets of the fidelity report."""

from dataclasses import dataclass, field

from i2t.heads.regression import HeadBudget


@dataclass(frozen=True)
class FidelityPreset:
    """Sizes of the report."""

    counts: tuple[int, ...] = (5, 10, 20, 50, 100, 300)  # presses to calibrate with
    draws: int = 5  # of them
    test_rows: int = 1000  # on which curves are scored
    forward_rows: int = 1200  # of the model by which noise and hysteresis are separated from the press
    block_mm: float = 6.0
    held_out_share: float = 0.2  # of blocks, rows or time
    try_causes: bool = True  # of a predictor that loses; else only those that show in the numbers
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
