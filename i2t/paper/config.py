"""Sizes of the paper's network and weights of its loss, without JAX, so that command lines can import them."""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from i2t.patches.dimensions import CONTACT_TOLERANCE_M, PATCH_PIXELS, REACH

ImageKind: TypeAlias = Literal["depth", "mask", "pressure"]


@dataclass(frozen=True)
class PaperOptions:
    """Layer widths of the paper's network, weight of the decoded patch in its loss, and depth (m) of a contact mask.

    The defaults are the paper's values, if it states any.

    Example:
        paper = i2t.PaperOptions(bottleneck=3)
        predictor = i2t.fit_predictor(dataset, split, method="paper-depth", paper=paper)
    """

    encoder_width: int = 200
    bottleneck: int = 5
    decoder_width: int = 500
    auxiliary_width: int = 2000
    auxiliary_weight: float = 1.0  # weight of the decoded patch in the loss; the paper states none
    tolerance: float = CONTACT_TOLERANCE_M  # m, depth behind the nearest point up to which a mask counts as contact

    def __post_init__(self) -> None:
        """Refuse impossible values (ValueError)."""
        for name in ("encoder_width", "bottleneck", "decoder_width", "auxiliary_width"):
            if getattr(self, name) < 1:
                raise ValueError(f"paper.{name} is {getattr(self, name)}; it must be at least 1.")
        for name in ("auxiliary_weight", "tolerance"):
            if not (getattr(self, name) >= 0 and math.isfinite(getattr(self, name))):
                raise ValueError(f"paper.{name} is {getattr(self, name)}; it must be a number >= 0.")


@dataclass(frozen=True)
class PaperConfig(PaperOptions):
    """Options of the paper's network with the kind, pixels and depth scale (m) of its image, and a reading's size."""

    pixels: int = PATCH_PIXELS
    readings: int = 15  # number of values of a reading, 3 for each chip of the board
    # image that the network takes: "depth" as in the text; "mask" as in the published code; "pressure" in N, unchanged
    input: ImageKind = "depth"
    reach: float = REACH  # m, depth of a patch that is scaled to 1

    def __post_init__(self) -> None:
        """Refuse impossible values (ValueError)."""
        super().__post_init__()
        if self.input not in get_args(ImageKind):
            raise ValueError(f"model.input is {self.input!r}; choose one of {', '.join(get_args(ImageKind))}.")
        for name in ("pixels", "readings"):
            if getattr(self, name) < 1:
                raise ValueError(f"model.{name} is {getattr(self, name)}; it must be at least 1.")
