"""The options of `python -m experiments.registration`, without JAX."""

from dataclasses import dataclass
from pathlib import Path

from experiments.common.options import RunOptions
from i2t.cli.options import Count, Positive
from i2t.patches.dimensions import PATCH_WINDOW

FRAME_FOLDERS = ("ycbvideo", "ycb_meshes", "apc_depth")


@dataclass(frozen=True)
class FramesArgs(RunOptions):
    """Compare imagined patches with those of real depth cameras."""

    data: Path  # folder with ycbvideo, ycb_meshes and apc_depth
    out: Path = Path("runs/registration_frames")  # folder for what is made
    sites: Count = 40  # on each object
    windows: tuple[Positive, ...] = (PATCH_WINDOW, 30e-3, 50e-3)  # m

    def check(self) -> None:
        """Refuse a folder without the recordings."""
        for folder in FRAME_FOLDERS:
            if not (self.data / folder).is_dir():
                raise ValueError(f"{self.data / folder} is missing; give --data a folder that holds it")
