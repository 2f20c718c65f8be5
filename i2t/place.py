"""Find the pose of an object from a depth view of it, and write it to the lab's calibration file.

    i2t place lab.toml --object mug.stl --unit mm --host 192.168.0.2 --write    # a RealSense on the arm
    i2t place lab.toml --object mug.stl --unit mm --views DIR --tool 0.41 -0.12 0.25 2.5 0 0 --write

Look at the object obliquely, 25 to 55 degrees from the vertical: from above, a flat top does not show its lateral
position. The search begins at the rig's T_world_object, which must be correct within centimetres and some degrees. The
camera must be calibrated (`i2t hand-eye`). The method is `i2t.registration.register_by_depth`. The
reported error is due to noise; it does not include a constant error of the camera or of its calibration.
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
    """Find the pose of an object from a depth view of it."""

    rig: tyro.conf.Positional[Path]  # the lab's calibration file
    object: str  # name of the object in the catalogue, or a mesh file
    unit: Literal["m", "cm", "mm", "inch"] | None = None  # unit of the mesh file, if its name has none (mug.stl:mm)
    # arm whose pose is read; the arm is not moved; give ur, a name that another package registers, or
    # package.module:Class
    arm: str = UR
    host: str | None = None  # address of the arm's controller; required for a UR arm
    # pose of the tool in the base, used instead of an arm: position (m) and rotation vector (rad), as on the pendant
    tool: Annotated[PoseVector | None, tyro.conf.arg(metavar="X Y Z RX RY RZ")] = None
    views: Path | None = None  # folder of saved views, used instead of a camera; only the first view is used
    camera: str = REALSENSE  # depth camera: realsense, or a camera of another package, named as for --arm
    # serial number of the RealSense, if several are plugged in; or the address of a camera of another package
    serial: str | None = None
    distance: float = 10e-3  # standard deviation (m) of the object's position in the rig along each axis
    angle: float = 6.0  # standard deviation (degrees) of the object's orientation in the rig about each axis
    hand_eye: Annotated[tuple[float, float], tyro.conf.arg(metavar="MM DEGREES")] = (1.0, 0.5)
    """Standard deviations of the camera's pose on the tool (mm, degrees); a view cannot show this error."""
    no_table: bool = False  # the view shows no table at z = 0 of the world
    write: bool = False  # write the pose to the calibration file


def place(args: PlaceArgs) -> str:
    """Find the pose of an object from a depth view of it, and write it to the rig if requested.

    Args:
        args: Options of the command line.

    Returns:
        Sentences on the estimated pose and its uncertainty.

    Raises:
        ValueError: A file cannot be understood, or the view does not determine the pose.
        OSError: A file cannot be read or written.
        DeviceError: The camera or the arm does not answer.
    """
    require_object(args.object, args.unit, flag="--object")
    require_path("--views", args.views, "folder")
    _require_devices(args)
    rig = Rig.read(args.rig)
    pose, arm = _pose_and_arm(args, rig)
    # Imported here, because JAX takes seconds, for which --help and refusals should not wait.
    from i2t.registration import camera_covariance, register_by_depth

    target = read_object(args.object, args.unit)
    with pose as T_b_t:
        camera, view = _look(args, rig, arm)
        T_w_c = rig.T_world_base @ T_b_t @ rig.T_tool_camera
        estimate = register_by_depth(
            target.mesh,
            rig.T_world_object,
            view.depth,
            camera,
            T_w_c,
            translation_std=args.distance,
            rotation_std=math.radians(args.angle),
            table_height=None if args.no_table else 0.0,
        )
    T_w_o = nearest_rigid(estimate.T_w_o)
    position_error, angle_error = args.hand_eye
    T_c_o = inverse(T_w_c) @ T_w_o
    covariance = camera_covariance(estimate.covariance, T_c_o, 1e-3 * position_error, math.radians(angle_error))
    noise, sigma = (np.sqrt(np.diag(np.asarray(matrix, float))) for matrix in (estimate.covariance, covariance))
    shift, turn = pose_difference(rig.T_world_object, T_w_o)
    fit = np.asarray(estimate.residual)[np.asarray(estimate.weight) > 0]
    lines = [
        f"{args.object} is {1e3 * shift:.1f} mm and {math.degrees(turn):.1f} degrees from its pose in {args.rig}",
        f"error from noise: {_spread(noise)}, with the camera's pose {_spread(sigma)}; {len(fit)} points fit within "
        f"{1e3 * float(np.sqrt(np.mean(fit**2))):.2f} mm RMS",
    ]
    if placement := describe_placement(target):
        lines.append(placement)
    if args.write:
        placed = replace(rig, T_world_object=T_w_o, object_from="registration", object_covariance=covariance)
        placed.write(args.rig)
        lines.append(f"{args.rig}: written")
    return "\n".join(lines)


def _require_devices(args: PlaceArgs) -> None:
    """Refuse unknown devices, and a pose of the tool that is missing or given twice."""
    find_plugin("arm", args.arm)
    find_plugin("camera", args.camera)
    reads_arm = args.host is not None or args.arm != UR
    if reads_arm == (args.tool is not None):
        raise ValueError("the pose of the tool is needed: give --host, or --tool with the pendant's six numbers")
    if args.views is not None and (args.camera != REALSENSE or args.serial):
        raise ValueError("--views replaces the camera by a folder; leave out --camera and --serial, or --views")


def _pose_and_arm(args: PlaceArgs, rig: Rig) -> tuple[AbstractContextManager[Array], GuardedArm | None]:
    """Get T_b_t for as long as it is needed, and the arm of another package, which its camera may use."""
    if args.tool is not None:
        return nullcontext(pose_from_vector(args.tool)), None
    tool = ToolPose(args.arm, args.host, rig)
    return tool.now(), tool.arm


def _look(args: PlaceArgs, rig: Rig, arm: GuardedArm | None) -> tuple[Camera, View]:
    if args.views is not None:
        return read_view(args.views)
    with load_device("camera", args.camera, DeviceSetup(rig, args.serial, arm)) as camera:
        return camera.camera, camera.capture()


def _spread(sigma: Array) -> str:
    """Describe standard deviations (6,) of a twist."""
    angle = math.degrees(np.linalg.norm(sigma[3:]) / TWIST_LEVER_M)
    return f"{1e3 * np.linalg.norm(sigma[:3]):.2f} mm and {angle:.2f} degrees"


main = command(PlaceArgs, lambda args: print(place(args)), program="python -m i2t.place", description=__doc__)


if __name__ == "__main__":
    sys.exit(main())
