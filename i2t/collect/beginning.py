"""Beginning of a collection: what can be known, and refused, without JAX and without a device.

The rig and the object are read, the folder is resumed, and the settings are held against the arm's limits.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.collect.arguments import CollectArgs, LabArgs
from i2t.collect.devices import require_together
from i2t.collect.notes import resume
from i2t.collect.path import TouchPath
from i2t.errors import printable
from i2t.hardware.plugins import find_plugin
from i2t.hardware.rig import Rig
from i2t.hardware.rig_checks import require_plausible
from i2t.objects.named import describe_placement, read_object
from i2t.objects.solids import Object, highest_point

NO_RIG = "a real arm needs to know its lab; write a rig (python -m i2t.hardware.rig) and pass --rig"


class Beginning(NamedTuple):
    """A collection before it has devices."""

    args: CollectArgs
    rig: Rig
    name: str  # of the object
    target: Object
    done: dict[int, float]  # sites that were touched and when (Unix time)
    notes: dict[str, Any]  # of the folder (`i2t.collect.notes`)


def begin(args: CollectArgs) -> Beginning:
    """Begin a collection, or go on with the one that was begun in its folder.

    Args:
        args: As on the command line.

    Returns:
        What `i2t.collect.session.collect` goes on with.

    Raises:
        ValueError: What was asked for does not go together, or cannot be read.
        UnreachableError: The way across the object is outside the box.
    """
    rig = read_rig(args.lab, real=find_plugin("arm", args.arm.kind).needs_rig)
    require_together(args, rig)
    target = read_object(args.world.object, args.world.unit, largest_piece=args.world.largest_piece)
    if placement := describe_placement(target):
        print(printable(placement))
    name = args.name or (target.name if args.world.object == target.name else Path(args.world.object).stem)
    if not args.lab.trust_rig and not args.dry_run:
        require_plausible(rig, target.mesh.vertices)
    TouchPath(rig, args.settings, highest_point(target, rig.T_world_object)).check_settings()
    return Beginning(args, rig, name, target, *resume(args, name, rig, target.mesh))


def read_rig(args: LabArgs, *, real: bool) -> Rig:
    """The lab's calibration, with the object where the command line says.

    Args:
        args: As on the command line.
        real: Whether a real arm will move.

    Returns:
        The rig; the emulators' own where none is named and no real arm is asked for.

    Raises:
        ValueError: A real arm needs a rig, or the file is damaged.
    """
    if args.rig is None and real:
        raise ValueError(NO_RIG)
    rig = Rig() if args.rig is None else Rig.read(args.rig)
    if args.pose is None:
        return rig
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = args.pose[:3], Rotation.from_euler("xyz", args.pose[3:], degrees=True).as_matrix()
    return replace(rig, T_world_object=T, object_from="given")
