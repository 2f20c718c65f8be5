"""Checks of a collection's command line before anything large is imported: files, names, and options that would have no
effect.
"""

from i2t.cli import check_options, require_path, require_with
from i2t.collect.arguments import ArmArgs, CameraArgs, CollectArgs, SkinArgs
from i2t.hardware.ur.config import check_watch
from i2t.objects.named import require_object
from i2t.simulation.site_limits import check_site_limits

SIMULATED, NOT_REAL = "simulated", ("simulated", "emulated")
SKINS = "reskin, simulated, emulated"  # that need no other package
MAX_OBJECT_M = 3.0  # of an object's pose in the world


def check_collect_args(args: CollectArgs) -> None:
    """Refuse files that are missing, and options that do not go together.

    Args:
        args: The options of the command.

    Raises:
        ValueError: A file or an object is missing, or an option has no effect; the message names its flag.
    """
    check_options(args)
    check_site_limits(args.sites)
    _check_pose(args.lab.pose)
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"--out {args.out}: is a file; name a folder")
    require_path("--rig", args.lab.rig, "file or folder")
    require_path("--pad", args.world.pad, "file or folder")
    check_arm(args.arm)
    check_camera(args.camera)
    check_skin(args.skin)
    if args.world.pad and args.skin.kind not in NOT_REAL:
        raise ValueError(f"--pad is of simulated skins, and --skin is {args.skin.kind}; leave it out")
    require_object(args.world.object, args.world.unit, flag="--object")


def _check_pose(pose: tuple[float, ...] | None) -> None:
    limits = 3 * (MAX_OBJECT_M,) + 3 * (360.0,)
    if pose is None or all(abs(value) <= most for value, most in zip(pose, limits, strict=True)):
        return
    raise ValueError(
        f"--pose is {' '.join(f'{value:g}' for value in pose)}; give x y z in m, each within {MAX_OBJECT_M:g} m, and "
        "turns about x y z in degrees, each within 360"
    )


def check_arm(arm: ArmArgs) -> None:
    """Refuse options of an arm that do not go together.

    Args:
        arm: The options.

    Raises:
        ValueError: An option is missing or has no effect; the message names its flag.
    """
    if arm.host and arm.kind == SIMULATED:
        raise ValueError(
            "--host is the address of a controller, and --arm is simulated; leave it out, or pass --arm ur"
        )
    if arm.kind == "ur" and not arm.host:
        raise ValueError("a UR arm needs the address of its controller; pass --host")
    check_watch(arm.state_timeout, arm.watchdog_rate)  # of a UR arm, real or emulated


def check_camera(camera: CameraArgs) -> None:
    """Refuse options of a camera that do not go together.

    Args:
        camera: The options.

    Raises:
        ValueError: An option has no effect; the message names its flag.
    """
    if camera.camera_serial and camera.kind == SIMULATED:
        raise ValueError(
            f"--camera-serial says which camera it is, and --camera is {camera.kind}; leave it out, or pass --camera "
            "realsense"
        )


def check_skin(skin: SkinArgs) -> None:
    """Refuse options of a skin that do not go together.

    Args:
        skin: The options.

    Raises:
        ValueError: A file or a board is missing, or an option has no effect; the message names its flag.
    """
    from i2t.hardware.named_devices import require_named
    from i2t.skin.boards import make_board

    require_named("skin", skin.kind, SKINS)
    if skin.board is not None:
        make_board(skin.board)
    require_with("--skin-serial", skin.skin_serial is not None, "--skin reskin", skin.kind == "reskin")
    if skin.skin_serial and skin.port:
        raise ValueError("--skin-serial and --port both say which board it is; leave one of them out")
    if skin.port and skin.kind == SIMULATED:
        raise ValueError(f"--port is of a board, and --skin is {skin.kind}; leave it out, or pass --skin reskin")
