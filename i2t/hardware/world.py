"""World of devices that are not real, without NumPy: the object, and the pads that touch it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from i2t.cli.options import Limits, Seed
from i2t.patches.dimensions import ARM_STIFFNESS_N_PER_M


@dataclass(frozen=True)
class WorldArgs:
    """The object, and the world of simulated and emulated devices."""

    FLAT: ClassVar[bool] = True  # flags are --object, not --world.object

    object: str = "hexagon"  # of the catalogue, or a mesh file
    # of a mesh file, which does not say it itself; so there is no default
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    largest_piece: bool = False  # of a mesh file is touched alone; the arm keeps clear of the rest
    pad: Path | None = None  # a pad on disk, for simulated and emulated skins; by default a random one
    seed: Seed = 0  # of the sites, and of what is simulated
    no_pose_error: bool = False  # simulated: object and camera are where they are believed to be
    stiffness: Annotated[float, Limits(100, 1e6)] = ARM_STIFFNESS_N_PER_M  # simulated: of arm and mount, N/m
