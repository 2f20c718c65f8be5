"""Options of `python -m experiments.registration`, free of JAX."""

from dataclasses import dataclass
from pathlib import Path

from experiments.common.options import RunOptions
from i2t.cli.options import Count, Positive
from i2t.patches.dimensions import PATCH_WINDOW


@dataclass(frozen=True)
class FramesArgs(RunOptions):
    """Compare rendered patches with those of real depth cameras."""

    data: Path  # folder with ycbvideo, ycb_meshes and apc_depth
    out: Path = Path("runs/registration_frames")  # output folder
    sites: Count = 40  # sites per object
    windows: tuple[Positive, ...] = (PATCH_WINDOW, 30e-3, 50e-3)  # edges of the patch windows, m

    def check(self) -> None:
        """Refuse a folder without the recordings."""
        for folder in ("ycbvideo", "ycb_meshes", "apc_depth"):
            if not (self.data / folder).is_dir():
                raise ValueError(f"{self.data / folder} is missing; give --data a folder that holds it")
