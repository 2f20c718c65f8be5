"""What a collection's command line is checked for before anything large is imported: files, names, and options that
would have no effect.
"""

from pathlib import Path

from i2t.cli import require_path, require_with
from i2t.collect.arguments import CollectArgs
from i2t.errors import DeviceError
from i2t.hardware.ur.config import check_watch
from i2t.objects.named import require_object

SIMULATED, NOT_REAL = "simulated", ("simulated", "emulated")


def check_collect_args(args: CollectArgs) -> None:
    """Refuse what is not there, and what does not go together.

    Args:
        args: The options of the command.

    Raises:
        ValueError: A file or an object is missing, or an option has no effect; the message names its flag.
    """
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"--out {args.out}: is a file; name a folder")
    for flag, path in (("--rig", args.rig), ("--pad", args.pad), ("--views", args.views), ("--replay", args.replay)):
        require_path(flag, path, "file or folder")
    require_with("--replay", args.replay is not None, "--skin replay", args.skin == "replay")
    if args.skin == "replay" and args.replay is None:
        raise ValueError("--skin replay needs a recording to play: pass --replay FILE")
    if args.board is not None:
        from i2t.skin.boards import make_board

        make_board(args.board)
    require_with("--views", args.views is not None, "--camera folder", args.camera == "folder")
    if args.camera == "folder" and args.views is None:
        raise ValueError("--camera folder needs a folder of views to show: pass --views DIR")
    if args.camera_serial and args.camera in (SIMULATED, "folder"):
        raise ValueError(
            f"--camera-serial says which camera it is, and --camera is {args.camera}; leave it out, or pass --camera "
            "realsense"
        )
    require_with("--skin-serial", args.skin_serial is not None, "--skin reskin", args.skin == "reskin")
    if args.skin_serial and args.port:
        raise ValueError("--skin-serial and --port both say which board it is; leave one of them out")
    if args.host and args.arm == SIMULATED:
        raise ValueError(
            "--host is the address of a controller, and --arm is simulated; leave it out, or pass --arm ur"
        )
    if args.port and args.skin in (SIMULATED, "replay"):
        raise ValueError(f"--port is of a board, and --skin is {args.skin}; leave it out, or pass --skin reskin")
    if args.pad and args.skin not in NOT_REAL:
        raise ValueError(f"--pad is of simulated skins, and --skin is {args.skin}; leave it out")
    check_watch(args.state_timeout, args.watchdog_rate)  # of a UR arm, real or emulated
    require_object(args.object, args.unit, flag="--object")
    if args.replay is not None:
        _require_recording(args.replay, args.board)


def _require_recording(path: Path, board: str | None) -> None:
    """Refuse a file in which no frames of the board are."""
    # Not above: NumPy, which other refusals need not wait for.
    from i2t.hardware.reskin.driver import Replay
    from i2t.skin.boards import DEFAULT_BOARD, make_board

    try:
        with Replay(path, chips=make_board(board or DEFAULT_BOARD).num_chips):
            pass
    except DeviceError as error:
        raise ValueError(f"--replay: {error}") from error
