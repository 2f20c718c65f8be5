"""Options and presets of `python -m experiments.active_touch`. This module has no slow imports."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.common.options import RunOptions
from i2t.errors import did_you_mean


@dataclass(frozen=True)
class ActiveTouchSizes:
    """Sizes of the experiment."""

    sites: int = 36
    other_pads: int = 4  # more pads on which predictions are compared with touches
    test_pads: int = 6
    placements: int = 24  # tabulated placements of each object
    particles: int = 48  # poses of each object in the belief
    touches: int = 16  # touches of an episode
    episodes: int = 240  # episodes over all pads


PRESETS: dict[str, ActiveTouchSizes] = {
    "paper": ActiveTouchSizes(),
    "debug": ActiveTouchSizes(
        sites=6, other_pads=3, test_pads=3, placements=3, particles=3, touches=3, episodes=12
    ),
}  # fmt: skip


@dataclass(frozen=True)
class ActiveTouchArgs(RunOptions):
    """Compare policies that choose touches, on held-out pads."""

    out: Path = Path("runs/active_touch")  # folder for the results
    preset: Literal["paper", "debug"] = "paper"  # size of the experiment; debug runs every part once
    # At least two names in the catalogue.
    objects: tuple[str, ...] = ("star", "hexagon", "cylinder", "cross", "square", "triangle")

    def check(self) -> None:
        """Refuse objects that the catalogue does not have, or too few (ValueError)."""
        from i2t.objects.catalogue import NAMES
        from i2t.objects.named import CATALOGUE_HINT

        unknown = [name for name in self.objects if name not in NAMES]
        if unknown:
            remedy = did_you_mean(unknown[0], NAMES, CATALOGUE_HINT)
            raise ValueError(f"--objects {unknown[0]}: is no object of the catalogue; {remedy}")
        if len(set(self.objects)) < max(2, len(self.objects)):
            raise ValueError("--objects needs at least two objects, each named once")
