"""Contact of the emulated UR arm's tool: with an object, through the skin's physics (`i2t.emulators.scene`).

The only part of that process that needs JAX, imported only if there is an object. The object stands where the rig's
file says it is, but for the errors of a session of that seed.
"""

import contextlib
import socket
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from i2t.emulators.carried_contact import CarriedContact, SeveralContacts
from i2t.emulators.scene import ContactModel, TouchableScene
from i2t.emulators.world import WorldConfig, carried_scene, make_scene
from i2t.hardware.rig import Rig
from i2t.types import Array


class BoardPublishingContactModel(ContactModel):
    """A contact model that tells a board what the skin feels, by datagrams: the skin's own field at rest, the room's as
    the tool is turned, and what a press changes. The board, which adds no field of its own, keeps the newest.

    Args:
        scene: What the tool meets.
        to: Address and port where the board listens.
        wait: Work out contact lines at once, not in a thread.
    """

    def __init__(self, scene: TouchableScene, to: tuple[str, int], wait: bool = False) -> None:
        super().__init__(scene, wait)
        self._to, self._sent = to, np.full(scene.board.num_readings, np.nan)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def close(self) -> None:
        """Send no more."""
        self._socket.close()

    def __call__(self, position: Float[Array, "3"], turned: Float[Array, "3 3"]) -> Float[Array, "6"]:
        """Wrench on the tool at a pose.

        Args:
            position: (3,) m, base axes.
            turned: (3, 3) tool axes in the base.

        Returns:
            (6,) N and Nm, base axes.
        """
        wrench = super().__call__(position, turned)
        reading = self.scene.rest + self.ambient(position, turned) + self.reading
        if not np.array_equal(reading, self._sent):
            with contextlib.suppress(OSError):
                self._socket.sendto(struct.pack(f"<{len(reading)}f", *reading), self._to)
                self._sent = reading
        return wrench


def make_contact_model(
    world: WorldConfig,
    rig: Path | None,
    board: tuple[str, int] | None,
    carried: Mapping[str, tuple[str, int]] | None = None,
) -> SeveralContacts:
    """The contact with an object; it takes some seconds, in which everything is compiled.

    Args:
        world: What is there.
        rig: File that says where; by default the emulators' own rig.
        board: Where an emulated board receives what the skin feels.
        carried: Where the boards of further skins of the rig do, by the skins' names.

    Returns:
        What a moving tool feels.

    Raises:
        ValueError: Object, pad or rig cannot be used, or the rig has no such skin.
        OSError: A file cannot be read.
    """
    setup, carried = Rig() if rig is None else Rig.read(rig), carried or {}
    unknown = set(carried) - {place.name for place in setup.skins}
    if unknown:
        raise ValueError(f"the rig has no skin {', '.join(sorted(unknown))}; correct --carried")
    scene = make_scene(world, setup)
    at = setup.T_base_world @ setup.T_world_object
    scene.ahead(at)  # compiled before anybody waits for it
    own = ContactModel(scene, wait=False) if board is None else BoardPublishingContactModel(scene, board)
    further = []
    for number, place in enumerate(setup.skins, 1):
        if place.name in carried:
            meets = carried_scene(world, setup, place.board, number)
            meets.ahead(at)
            model = BoardPublishingContactModel(meets, carried[place.name])
            further.append(CarriedContact(model, place.T_tool_skin))
    return SeveralContacts(own, further)
