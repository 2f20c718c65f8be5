"""World of simulated and emulated devices: an object of the catalogue or a mesh file, and the pads that touch it.

Nothing large is imported before a scene or a pad is made.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from i2t.hardware.world import WorldArgs

if TYPE_CHECKING:
    from i2t.emulators.scene import ObjectScene
    from i2t.hardware.rig import Rig
    from i2t.types import Pad

DEFAULT_PAD_KEY = 1000  # random seed of the emulated skin's default pad, which is pad 0 of experiments.train


def read_pad(path: Path | None, board: str | None = None) -> "Pad":
    """Read the pad that touches the object in a simulation, or make the default random one.

    Args:
        path: Path of the pad's file, or None for the random one.
        board: Name of the board that the pad must be on; by default any, and ReSkin's for the random pad.

    Returns:
        The pad that touches the object.

    Raises:
        ValueError: If the file holds no pad, or one on another board.
        OSError: If the file cannot be read.
    """
    from i2t.skin.boards import DEFAULT_BOARD, make_board, same_board
    from i2t.skin.files import load_pad

    if path is None:
        return _random_pad(DEFAULT_PAD_KEY, board or DEFAULT_BOARD)
    pad = load_pad(path)
    if board is not None and not same_board(pad.board, make_board(board)):
        raise ValueError(
            f"{path}: is a pad on a board of {pad.board.num_chips} chips, which differs from {board}, of "
            f"{make_board(board).num_chips}; pass the --board that it was made for, or another --pad"
        )
    return pad


def _random_pad(key: int, board: str) -> "Pad":
    import jax

    from i2t.skin.boards import make_board
    from i2t.skin.pad import sample_pad

    return sample_pad(jax.random.key(key), board=make_board(board))


def make_scene(world: WorldArgs, rig: "Rig", board: str | None = None, number: int = 0) -> "ObjectScene":
    """Make a scene with an object at its pose in the rig, displaced by random errors drawn with `world.seed`.

    Args:
        world: The object, the pad and the seed.
        rig: Calibration of the lab.
        board: Name of the board of the skin that touches the object; by default that of the pad, or ReSkin's.
        number: Number, from 1, of a further skin on the tool, which has a random pad of its own; 0 for the pressing
            skin.

    Returns:
        The scene of this skin and the camera.

    Raises:
        ValueError: If object or pad cannot be used.
        OSError: If a file cannot be read.
    """
    from i2t.emulators.scene import ObjectScene
    from i2t.objects.named import read_object
    from i2t.simulation.touches import SimulationErrors

    pad = _random_pad(1900 + number, board) if number and board else read_pad(world.pad, board)
    errors = SimulationErrors().scaled(0.0) if world.no_pose_error else SimulationErrors()
    mesh = read_object(world.object, world.unit).mesh  # all pieces of the object, whichever is to be touched
    T_b_o = rig.T_base_world @ rig.T_world_object
    return ObjectScene(mesh, T_b_o, pad, errors, stiffness=world.stiffness, seed=world.seed)
