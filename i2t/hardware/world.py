"""World of simulated and emulated devices, without NumPy: the object, and the pads that touch it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from i2t.cli.options import Limits, Seed
from i2t.patches.dimensions import ARM_STIFFNESS_N_PER_M


@dataclass(frozen=True)
class WorldArgs:
    """Options of the object to touch, and of pad, pose errors, stiffness and seed of simulated and emulated devices."""

    FLAT: ClassVar[bool] = True  # flags are --object, not --world.object

    object: str = "hexagon"  # name of the object in the catalogue, or a mesh file
    unit: Literal["m", "cm", "mm", "inch"] | None = None  # unit of the mesh file, if its name has none (mug.stl:mm)
    largest_piece: bool = False  # touch only the largest piece of a mesh file; the arm avoids the rest
    pad: Path | None = None  # pad file for simulated and emulated skins; by default, a random pad
    seed: Seed = 0  # seed of the sites and of the simulation
    no_pose_error: bool = False  # simulate object and camera exactly at their poses in the rig, without errors
    # stiffness (N/m) of the simulated arm and its mount
    stiffness: Annotated[float, Limits(100, 1e6)] = ARM_STIFFNESS_N_PER_M
