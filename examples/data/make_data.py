"""Make the files that code on the pages reads: a mesh of a mug, and a table of simulated presses.

python examples/data/make_data.py
"""

import csv
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from manifold3d import Manifold, OpType

import i2t
from i2t.objects.drawing import ball, mesh_from_solid
from i2t.skin.elasticity import GRID
from i2t.skin.pad import pad_from_seed

HERE = Path(__file__).parent
PRESSES = 100


def bar(bends: list[tuple[float, float, float]]) -> Manifold:
    """Make a bent round bar of 8 mm diameter, as the hulls of consecutive balls (mm)."""
    balls = [ball(4.0).translate(bend) for bend in bends]
    return Manifold.batch_boolean([Manifold.batch_hull(pair) for pair in pairwise(balls)], OpType.Add)


def mug() -> i2t.Mesh:
    """Make a mug lying on z = 0 with its handle up, so that wall, rim and handle can be touched from above."""
    radius, wall, height, sides = 26.0, 3.5, 60.0, 72  # mm
    bends = [(24, 0, 48), (34, 0, 50), (41, 0, 42), (42, 0, 30), (39, 0, 20), (24, 0, 12)]
    outside = Manifold.cylinder(height, radius, circular_segments=sides)
    inside = Manifold.cylinder(height, radius - wall, circular_segments=sides).translate((0, 0, wall))
    solid = (outside + bar(bends) - inside).simplify(0.05)
    lying = solid.rotate((0, -90, 0)).rotate((35, 0, 0))
    return mesh_from_solid(lying.translate((0, 0, -lying.bounding_box()[2])))


def presses() -> list[list[str]]:
    """Simulate presses of a ball of 4 mm radius on simulated pad 0, as a table whose first row is the header."""
    random, pad = np.random.default_rng(0), pad_from_seed(0)
    x, y = random.uniform(-6, 6, (2, PRESSES)).round(2)
    travel = random.uniform(0.1, 0.6, PRESSES).round(2)

    def press(at: jax.Array) -> tuple[jax.Array, jax.Array]:
        squared = (GRID.centres[None, :] - at[0]) ** 2 + (GRID.centres[:, None] - at[1]) ** 2
        pressed = i2t.press(pad, squared / (2 * 4e-3), at[2])
        return pressed.reading, pressed.force

    readings, forces = map(np.asarray, jax.lax.map(press, jnp.asarray(1e-3 * np.column_stack([x, y, travel]))))
    readings = readings + random.normal(0, 1.0, readings.shape)  # uT
    names = ["x_mm", "y_mm", "travel_mm", "force_N", *(f"b{chip}{axis}_uT" for chip in range(5) for axis in "xyz")]
    numbers = zip(x, y, travel, forces, readings, strict=True)
    return [
        [*names, "pad", "source"],
        *([f"{a:.2f}", f"{b:.2f}", f"{d:.2f}", f"{f:.3f}", *(f"{v:.1f}" for v in r), "pad 0", "simulated"]
          for a, b, d, f, r in numbers),
    ]  # fmt: skip


def main(folder: Path = HERE) -> None:
    """Write mug.stl, in millimetres, and presses.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    mesh = mug()
    trimesh.Trimesh(1e3 * mesh.vertices, mesh.faces, process=False).export(folder / "mug.stl")
    with (folder / "presses.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(presses())
    print(f"wrote mug.stl ({len(mesh.faces)} faces) and presses.csv ({PRESSES} simulated presses) into {folder}")


if __name__ == "__main__":
    main()
