"""The options of `python -m experiments.real_frames`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from i2t.cli import Count, Limits, NotNegative, Positive, Probability, Seed
from i2t.types import PATCH_WINDOW, STANDOFF

FRAME_FOLDERS = ("ycbvideo", "ycb_meshes", "apc_depth")


@dataclass(frozen=True)
class RealFrames:
    """Compare imagined patches with those of real depth cameras."""

    data: Path  # folder with ycbvideo, ycb_meshes and apc_depth
    out: Path = Path("runs/real_frames")
    sites: Count = 40  # on each object
    windows: tuple[Positive, ...] = (PATCH_WINDOW, 30e-3, 50e-3)  # m
    seed: Seed = 0
    overwrite: bool = False  # replace a finished run in --out
    min_cosine: Probability = 0.5  # least cosine between a site's normal and the line of sight
    max_occlusion_m: Positive = 8e-3  # where the image is further than this from the mesh, something else is in front
    border_px: Annotated[int, Limits(0)] = 3  # from a site to the border of the object's label
    # How much further than the reach a real patch is read, so that neither noise nor something in front clips it
    extra_reach_m: NotNegative = STANDOFF
    min_share: Probability = 0.1  # share of a patch's pixels that must be comparable
    f200_fill_m: NotNegative = 4e-3  # every fifth row and column of the F200's frames is empty, 1 to 1.6 mm wide

    def check(self) -> None:
        """Refuse a folder without the recordings."""
        for folder in FRAME_FOLDERS:
            if not (self.data / folder).is_dir():
                raise ValueError(f"{self.data / folder} is missing; give --data a folder that holds it")
