"""Start of a collection: everything that can be read, and refused, without JAX and without a device.

The rig and the object are read, the folder is resumed, and the settings are compared with the arm's limits.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.collect.arguments import CollectArgs, LabArgs
from i2t.collect.devices import require_compatible
from i2t.collect.folder_notes import resume
from i2t.collect.path import TouchPath
from i2t.errors import printable
from i2t.hardware.plugins import find_plugin
from i2t.hardware.rig import Rig
from i2t.hardware.rig_checks import require_plausible
from i2t.objects.named import describe_placement, object_name, read_object
from i2t.objects.solids import Object, highest_point

# Error if a collection with a real arm is started without a rig.
MISSING_RIG_MESSAGE = "a real arm needs the calibration of its lab; write a rig (i2t rig) and pass --rig"


class PreparedCollection(NamedTuple):
    """A collection before its devices are made: options, rig, object, notes of the folder, and the Unix time (s) of
    each touch that the folder already holds.
    """

    args: CollectArgs
    rig: Rig
    name: str  # name of the object
    target: Object
    done: dict[int, float]  # Unix time (s) of each touch, by the number of its site
    notes: dict[str, Any]  # notes of the folder (`i2t.collect.folder_notes`)


def begin(args: CollectArgs) -> PreparedCollection:
    """Begin a collection, or resume the one in its folder: check the options, and read rig, object and notes.

    Args:
        args: Arguments as on the command line.

    Returns:
        The collection that `i2t.collect.session.collect` carries out.

    Raises:
        ValueError: If options contradict each other, or a file cannot be read.
        UnreachableError: If the transfer height above the object is outside the arm's box.
    """
    rig = read_rig(args.lab, real=find_plugin("arm", args.arm.kind).needs_rig)
    require_compatible(args, rig)
    target = read_object(args.world.object, args.world.unit, largest_piece=args.world.largest_piece)
    if placement := describe_placement(target):
        print(printable(placement))
    name = args.name or object_name(args.world.object)
    if not args.lab.accept_unusual_rig and not args.dry_run:
        require_plausible(rig, target.mesh.vertices)
    TouchPath(rig, args.settings, highest_point(target, rig.T_world_object)).check_settings()
    return PreparedCollection(args, rig, name, target, *resume(args, name, rig, target.mesh))


def read_rig(args: LabArgs, *, real: bool) -> Rig:
    """Read the rig (the lab's calibration); a pose of the object on the command line replaces the rig's.

    Args:
        args: Arguments as on the command line.
        real: Whether a real arm will move.

    Returns:
        The rig. It is that of the emulators if none is named and no real arm is requested.

    Raises:
        ValueError: If a real arm has no rig, or the file is damaged.
    """
    if args.rig is None and real:
        raise ValueError(MISSING_RIG_MESSAGE)
    rig = Rig() if args.rig is None else Rig.read(args.rig)
    if args.pose is None:
        return rig
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = args.pose[:3], Rotation.from_euler("xyz", args.pose[3:], degrees=True).as_matrix()
    return replace(rig, T_world_object=T, object_from="given")
