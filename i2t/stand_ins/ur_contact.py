"""What the tool of the emulated UR arm touches: a mesh through the skin's physics (`i2t.stand_ins.scene`).

The only part of that process that needs JAX, imported only if there is a mesh. The object stands where the rig's file
says it is, displaced by the placement error of `--errors typical`; the pad is the one of `--pad-seed`, so that the
emulated board shows what the arm's wrench comes from.
"""

from pathlib import Path

import jax
import numpy as np

from i2t import objects
from i2t.hardware.rig import Rig
from i2t.skin.pad import sample_pad
from i2t.solids import Mesh
from i2t.stand_ins.scene import Feeler, Scene
from i2t.types import Array
from i2t.world import Errors

ERRORS = {"none": Errors.none, "typical": Errors}


def feeler(mesh: str, unit: str, rig: Path | None, errors: str, pad_seed: int, seed: int, stiffness: float) -> Feeler:
    """The contact of a catalogue's object, or of a mesh file in `unit`; raises ValueError or OSError, one sentence.

    `stiffness` is that of arm and mount in N/m. It takes some seconds, in which everything is compiled.
    """
    setup = Rig() if rig is None else Rig.read(rig)
    shape: Mesh = objects.make(mesh).mesh if mesh in objects.NAMES else objects.load(Path(mesh), unit)[0].mesh
    T_b_o = setup.T_base_world @ setup.T_world_object
    scene = Scene(shape, T_b_o, jax.jit(sample_pad)(jax.random.key(pad_seed)), ERRORS[errors](), stiffness, seed)
    scene.ahead(_above(T_b_o, shape))  # compiles, so that nothing waits for it later
    return Feeler(scene, wait=False)


def _above(T_b_o: Array, mesh: Mesh) -> Array:
    T = np.eye(4)
    T[:3, :3] = T_b_o[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = T_b_o[:3, 3] + T_b_o[:3, 2] * (mesh.vertices[:, 2].max() + 0.04)
    return T
