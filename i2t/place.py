"""Pose of an object, from a depth view of it: the pose goes into the lab's calibration file.

    python -m i2t.place lab.toml --object mug.stl --unit mm --host 192.168.0.2 --write    # a RealSense on the arm
    python -m i2t.place lab.toml --object mug.stl --unit mm --views DIR --tool 0.41 -0.12 0.25 2.5 0 0 --write

Look at it obliquely, 25 to 55 degrees from the vertical: from above, a flat top shows nothing sideways. The rig's own
T_world_object is where the search begins, within centimetres and some degrees; the camera must be calibrated
(`python -m i2t.hardware.hand_eye`). How it is found is in `i2t.registration.register_by_depth`; the error that is
reported is that of noise, and knows nothing of a constant error of the camera or of its calibration.
"""

import math
import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import require_path
from i2t.depth.camera import Camera
from i2t.geometry import inverse, nearest_rigid
from i2t.hardware.camera_folder import read_view
from i2t.hardware.plugins import REALSENSE, UR, DeviceSetup, ToolPose, find_plugin, load_device
from i2t.hardware.poses import pose_difference, pose_from_vector
from i2t.hardware.protocols import GuardedArm, View
from i2t.hardware.rig import Rig
from i2t.objects.named import describe_placement, read_object, require_object
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.types import Array

PoseVector = tuple[float, float, float, float, float, float]  # position (m) and rotation vector (rad)


@dataclass(frozen=True)
class PlaceArgs:
    """Find where an object stands from a depth view of it."""

    rig: tyro.conf.Positional[Path]  # the lab's calibration
    object: str  # a name of the catalogue, or a mesh file
    unit: Literal["m", "cm", "mm", "inch"] | None = None  # of a mesh file; no default
    arm: str = UR
    """That is asked where it stands and not moved; or another package's: the name that it registers, or
    package.module:Class."""
    host: str | None = None  # its address; a UR arm needs one
    tool: Annotated[PoseVector | None, tyro.conf.arg(metavar="X Y Z RX RY RZ")] = None  # or where the tool was: m, rad
    views: Path | None = None  # a folder of views, of which the first is taken; else a camera
    camera: str = REALSENSE  # or another package's
    serial: str | None = None  # which RealSense, if there are several; the address of another package's camera
    distance: float = 10e-3  # m, how far off the rig may be (one sigma)
    angle: float = 6.0  # degrees, the same
    hand_eye: Annotated[tuple[float, float], tyro.conf.arg(metavar="MM DEGREES")] = (1.0, 0.5)
    """How far off the camera may be on its tool (one sigma), which no view shows."""
    no_table: bool = False  # the view shows no table at the world's z = 0
    write: bool = False  # put the pose into the rig


def place(asked: PlaceArgs) -> str:
    """Find the object's pose.

    Args:
        asked: The command line.

    Returns:
        What was found, as sentences.

    Raises:
        ValueError: What was asked for cannot be read, or the view does not determine the pose.
        OSError: A file cannot be read or written.
        DeviceError: Camera or arm do not answer.
    """
    require_object(asked.object, asked.unit, flag="--object")
    require_path("--views", asked.views, "folder")
    _require_devices(asked)
    rig = Rig.read(asked.rig)
    pose, arm = _pose_and_arm(asked, rig)
    # Not above: JAX takes seconds, which --help and a refusal need not wait for.
    from i2t.registration import camera_covariance, register_by_depth

    target = read_object(asked.object, asked.unit)
    with pose as T_b_t:
        camera, view = _look(asked, rig, arm)
        T_w_c = rig.T_world_base @ T_b_t @ rig.T_tool_camera
        found = register_by_depth(
            target.mesh,
            rig.T_world_object,
            view.depth,
            camera,
            T_w_c,
            translation_std=asked.distance,
            rotation_std=math.radians(asked.angle),
            table_height=None if asked.no_table else 0.0,
        )
    T_w_o = nearest_rigid(found.T_w_o)
    position_error, angle_error = asked.hand_eye
    T_c_o = inverse(T_w_c) @ T_w_o
    covariance = camera_covariance(found.covariance, T_c_o, 1e-3 * position_error, math.radians(angle_error))
    noise, sigma = (np.sqrt(np.diag(np.asarray(each, float))) for each in (found.covariance, covariance))
    shift, turn = pose_difference(rig.T_world_object, T_w_o)
    fit = np.asarray(found.residual)[np.asarray(found.weight) > 0]
    lines = [
        f"{asked.object} is {1e3 * shift:.1f} mm and {math.degrees(turn):.1f} degrees from what {asked.rig} says",
        f"noise leaves {_spread(noise)}, with the camera's own place {_spread(sigma)}; {len(fit)} points fit within "
        f"{1e3 * float(np.sqrt(np.mean(fit**2))):.2f} mm RMS",
    ]
    if placement := describe_placement(target):
        lines.append(placement)
    if asked.write:
        placed = replace(rig, T_world_object=T_w_o, object_from="registration", object_covariance=covariance)
        placed.write(asked.rig)
        lines.append(f"{asked.rig}: written")
    return "\n".join(lines)


def _require_devices(asked: PlaceArgs) -> None:
    """Refuse devices that are not known, and a pose of the tool that is missing or given twice."""
    find_plugin("arm", asked.arm)
    find_plugin("camera", asked.camera)
    asks_an_arm = asked.host is not None or asked.arm != UR
    if asks_an_arm == (asked.tool is not None):
        raise ValueError("the pose of the tool is needed: give --host, or --tool with the pendant's six numbers")
    if asked.views is not None and (asked.camera != REALSENSE or asked.serial):
        raise ValueError("--views shows a folder in place of a camera; leave out --camera and --serial, or --views")


def _pose_and_arm(asked: PlaceArgs, rig: Rig) -> tuple[AbstractContextManager[Array], GuardedArm | None]:
    """T_b_t while it is needed, and another package's arm, which its camera may ask."""
    if asked.tool is not None:
        return nullcontext(pose_from_vector(asked.tool)), None
    tool = ToolPose(asked.arm, asked.host, rig)
    return tool.now(), tool.arm


def _look(asked: PlaceArgs, rig: Rig, arm: GuardedArm | None) -> tuple[Camera, View]:
    if asked.views is not None:
        return read_view(asked.views)
    with load_device("camera", asked.camera, DeviceSetup(rig, asked.serial, arm)) as camera:
        return camera.camera, camera.capture()


def _spread(sigma: Array) -> str:
    """Standard deviations (6,) of a twist, for a sentence."""
    turn = math.degrees(np.linalg.norm(sigma[3:]) / TWIST_LEVER_M)
    return f"{1e3 * np.linalg.norm(sigma[:3]):.2f} mm and {turn:.2f} degrees"


main = command(PlaceArgs, lambda asked: print(place(asked)), program="python -m i2t.place", description=__doc__)


if __name__ == "__main__":
    sys.exit(main())
