"""What the tool of the emulated UR arm touches: an object, through the skin's physics (`i2t.emulators.scene`).

The only part of that process that needs JAX, imported only if there is an object. The object stands where the rig's
file says it is, but for the errors of a run of that seed.
"""

import contextlib
import socket
import struct
from pathlib import Path

import jax
import numpy as np

from i2t.emulators.scene import Feeler, Met, Scene
from i2t.hardware.rig import Rig
from i2t.objects import catalogue
from i2t.simulation.touches import Errors
from i2t.skin.files import load_pad
from i2t.skin.pad import sample_pad
from i2t.types import READINGS, Array

PAD = 1000  # key of the random pad, the same as pad 0 of experiments.train


class BoardPublishingContactModel(Feeler):
    """A feeler that tells a board what it feels, by datagrams: the skin's own field at rest and what a press changes.
    The board keeps the newest.
    """

    def __init__(self, scene: Met, to: tuple[str, int], wait: bool = False) -> None:
        super().__init__(scene, wait)
        self._to, self._told = to, np.full(READINGS, np.nan)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def __call__(self, position: Array, turned: Array) -> Array:
        """Wrench (6,) on the tool at a pose, base axes."""
        wrench = super().__call__(position, turned)
        if not np.array_equal(self.reading, self._told):
            with contextlib.suppress(OSError):
                self._socket.sendto(struct.pack(f"<{READINGS}f", *(self.scene.rest + self.reading)), self._to)
                self._told = self.reading
        return wrench


def feeler(
    name: str,
    unit: str,
    rig: Path | None,
    pad: Path | None,
    seed: int,
    exact: bool,
    stiffness: float,
    board: tuple[str, int] | None,
) -> Feeler:
    """The contact with an object of the catalogue, or a mesh file in `unit`; raises ValueError or OSError, with one
    sentence.

    With `exact` there are no errors of placement; `stiffness` is that of arm and mount in N/m; `board` is where an
    emulated board wants to be told. It takes some seconds, in which everything is compiled.
    """
    setup = Rig() if rig is None else Rig.read(rig)
    mesh = (catalogue.make_object(name) if name in catalogue.NAMES else catalogue.load_mesh(name, unit)[0]).mesh
    skin = jax.jit(sample_pad)(jax.random.key(PAD)) if pad is None else load_pad(pad)
    errors = Errors().scaled(0.0) if exact else Errors()
    scene = Scene(mesh, setup.T_base_world @ setup.T_world_object, skin, errors, stiffness, seed)
    scene.ahead(setup.T_base_world @ setup.T_world_object)  # compiled before anybody waits for it
    return Feeler(scene, wait=False) if board is None else BoardPublishingContactModel(scene, board)
