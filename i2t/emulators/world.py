"""World of simulated and emulated devices: an object of the catalogue or a mesh file, and the pad that touches it.

JAX is imported only once a scene is made.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from i2t.emulators.processes import Address
from i2t.hardware.rig import Rig
from i2t.objects.named import read_object
from i2t.skin.boards import DEFAULT_BOARD, make_board, same_board

if TYPE_CHECKING:
    from i2t.emulators.scene import Contacts, ObjectScene
    from i2t.types import Pad

DEFAULT_PAD_KEY = 1000  # of the random pad that is worn where none is named, the same as pad 0 of experiments.train
CARRIED_PAD_KEY = 1900  # of the random pad of a further skin on the tool, plus its number


@dataclass(frozen=True)
class WorldConfig:
    """World that simulated and emulated devices meet."""

    object: str  # of the catalogue, or a mesh file
    unit: str | None = None  # of a mesh file
    pad: Path | None = None  # on disk; by default a random one
    seed: int = 0  # of the errors
    no_pose_error: bool = False  # object and camera are where they are believed to be
    stiffness: float = 10e3  # N/m, of arm and mount
    board: str | None = None  # that the pad is on (`i2t.skin.boards.make_board`): a pad on disk's own, else ReSkin's


def read_pad(path: Path | None, board: str | None = None) -> "Pad":
    """A pad on disk, or the random one that is worn where none is named.

    Args:
        path: Of the pad, or None.
        board: Name of the board that the pad must be on; by default any, and ReSkin's for the random one.

    Returns:
        The pad.

    Raises:
        ValueError: The file holds no pad, or one on another board.
        OSError: It cannot be read.
    """
    import jax

    from i2t.skin.files import load_pad
    from i2t.skin.pad import sample_pad

    if path is None:
        return sample_pad(jax.random.key(DEFAULT_PAD_KEY), board=make_board(board or DEFAULT_BOARD))
    pad = load_pad(path)
    if board is not None and not same_board(pad.board, make_board(board)):
        raise ValueError(
            f"{path}: is a pad on another board, of {pad.board.num_chips} chips, than {board}, of "
            f"{make_board(board).num_chips}; pass the --board that it was made for, or another --pad"
        )
    return pad


def make_scene(world: WorldConfig, rig: Rig) -> "ObjectScene":
    """The object where the rig says that it stands, but for the errors of a session of that seed.

    Args:
        world: What is there.
        rig: Where it is.

    Returns:
        What tool and camera meet.

    Raises:
        ValueError: Object or pad cannot be used.
        OSError: A file cannot be read.
    """
    return _scene(world, rig, read_pad(world.pad, world.board))


def _scene(world: WorldConfig, rig: Rig, pad: "Pad") -> "ObjectScene":
    from i2t.emulators.scene import ObjectScene
    from i2t.simulation.touches import SimulationErrors

    errors = SimulationErrors().scaled(0.0) if world.no_pose_error else SimulationErrors()
    mesh = read_object(world.object, world.unit).mesh
    T_b_o = rig.T_base_world @ rig.T_world_object
    return ObjectScene(mesh, T_b_o, pad, errors, stiffness=world.stiffness, seed=world.seed)


def carried_scene(world: WorldConfig, rig: Rig, board: str, number: int) -> "ObjectScene":
    """The same object as a further skin on the tool meets it, with a random pad of its own.

    Args:
        world: What is there.
        rig: Where it is.
        board: Name of the skin's board.
        number: Of the skin, from 1.

    Returns:
        What this skin meets.

    Raises:
        ValueError: The object cannot be used.
        OSError: A file cannot be read.
    """
    import jax

    from i2t.skin.pad import sample_pad

    pad = sample_pad(jax.random.key(CARRIED_PAD_KEY + number), board=make_board(board))
    return _scene(world, rig, pad)


def make_contacts(
    world: WorldConfig, rig: Path | None, to: Address | None, carried: Mapping[str, Address]
) -> "Contacts":
    """The contacts of an emulated arm with an object; it takes some seconds, in which everything is compiled.

    Args:
        world: What is there.
        rig: File that says where; by default the emulators' own rig.
        to: Where an emulated board receives what the skin feels.
        carried: Where the boards of further skins of the rig do, by the skins' names.

    Returns:
        What a moving tool feels.

    Raises:
        ValueError: Object, pad or rig cannot be used, or the rig has no such skin.
        OSError: A file cannot be read.
    """
    from i2t.emulators.scene import ContactModel, Contacts

    setup = Rig() if rig is None else Rig.read(rig)
    unknown = set(carried) - {place.name for place in setup.skins}
    if unknown:
        raise ValueError(f"the rig has no skin {', '.join(sorted(unknown))}; correct --carried")
    models = [ContactModel(make_scene(world, setup), wait=False, to=to)]
    for number, place in enumerate(setup.skins, 1):
        if place.name in carried:
            meets = carried_scene(world, setup, place.board, number)
            models.append(ContactModel(meets, False, place.T_tool_skin, carried[place.name]))
    for model in models:
        model.scene.ahead(setup.T_base_world @ setup.T_world_object)  # compiled before anybody waits for it
    return Contacts(models)
