"""Nodes of the 3-D scene that several scenes draw: the skin with the field at its chips, and discs at touches.

Positions are in metres. The field is drawn as in the pictures (`i2t.viz.skins.draw_reading`): an arrow for the field at
a chip, with an ellipsoid of one standard deviation at its tip, and a disc as wide as the field normal to the skin, dark
where it points out of the skin.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import trimesh
import viser.transforms
from jaxtyping import Float
from matplotlib.colors import to_rgb

from i2t import viz
from i2t.patches.dimensions import PAD_WINDOW
from i2t.prediction.touch_model import Reading
from i2t.types import Board
from i2t.viz.skins import arrow_mm, drawn_field
from i2t.viz.style import CURVE_COLOURS, MM_PER_M

SKIN_COLOUR = (225, 150, 120)
BALL = trimesh.creation.icosphere(subdivisions=2)  # of radius 1
DISC = trimesh.creation.cylinder(radius=1.0, height=0.08)


def quaternions(rotations: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 4"]:
    """Convert rotations to the quaternions of the scene.

    Args:
        rotations: Rotation matrices.

    Returns:
        Quaternions in the order w, x, y, z.
    """
    return viser.transforms.SO3.from_matrix(np.asarray(rotations, np.float64)).wxyz


def place(node: Any, T: Float[np.ndarray, "4 4"]) -> None:
    """Move a node of the scene.

    Args:
        node: The node.
        T: Its pose in its parent's frame (m).
    """
    node.wxyz, node.position = quaternions(T[:3, :3]), T[:3, 3]


def add_mesh(scene: Any, name: str, mesh: Any, **options: Any) -> Any:
    """Add an object to the scene.

    Args:
        scene: The scene.
        name: Name of the node.
        mesh: The object, with `vertices` (m) and `faces`.
        options: Further arguments of viser's `add_mesh_simple`.

    Returns:
        Node of the object, which takes a callback for clicks.
    """
    options = {"color": (190, 190, 190), "flat_shading": True, "side": "double", **options}
    return scene.add_mesh_simple(name, np.asarray(mesh.vertices), np.asarray(mesh.faces), **options)


def add_discs(
    scene: Any, name: str, T: Float[np.ndarray, "n 4 4"], colours: Float[np.ndarray, "n 3"], radius: float = 2.5e-3
) -> Any:
    """Add a disc for each touch or site.

    Args:
        scene: The scene.
        name: Name of the node.
        T: Tool poses (m).
        colours: RGB values from 0 to 1.
        radius: Radius (m) of the discs.

    Returns:
        The node, whose clicks give the index of the disc.
    """
    return scene.add_batched_meshes_simple(
        name, DISC.vertices * radius, DISC.faces, quaternions(T[:, :3, :3]), T[:, :3, 3],
        batched_colors=(255 * colours).astype(np.uint8), lod="off",
    )  # fmt: skip


def measured(values: Float[np.ndarray, " c"]) -> Reading:
    """Give a measured or simulated reading the form of a predicted one.

    Args:
        values: `(c,)` reading (uT).

    Returns:
        The reading with standard deviations of 0, which are not drawn.
    """
    return Reading(values, np.zeros_like(values))


def picture_of(
    patch: Float[np.ndarray, "1 n n"],
    readings: Mapping[str, Reading],
    board: Board,
    title: str,
    simulated: bool,
    **options: Any,
) -> np.ndarray:
    """Draw the patch of a touch, and below it the readings, as the figures of the documents do.

    Args:
        patch: The depth patch (m).
        readings: Readings (uT) by name.
        board: Board of the readings.
        title: Title of the picture.
        simulated: Whether any of the data are simulated.
        options: Further arguments of `i2t.viz.plot_predicted_touches`.

    Returns:
        `(rows, columns, 3)` RGB values from 0 to 255.
    """
    means = {name: np.nan_to_num(reading.mean)[None] for name, reading in readings.items()}
    std = {name: reading.std[None] for name, reading in readings.items() if reading.std.any()}
    return viz.pixels(viz.plot_predicted_touches(patch, means, [""], board, title, simulated, std=std, **options))


class SkinNode:
    """The skin in the scene, and behind it the field at its chips.

    Args:
        scene: The scene.
        name: Name of the node in whose frame, that of the tool, the skin lies.
        lift: Distance (m) of the drawn field behind the skin, where no object hides it.
    """

    def __init__(self, scene: Any, name: str, lift: float = 30e-3) -> None:
        self._scene, self._name, self._sets = scene, name, 0
        size = (PAD_WINDOW, PAD_WINDOW)
        scene.add_box(f"{name}/skin", color=SKIN_COLOUR, dimensions=(*size, 2e-3), position=(0, 0, -1e-3), opacity=0.75)
        scene.add_frame(f"{name}/field", show_axes=False, position=(0, 0, -lift))
        if lift:
            scene.add_box(f"{name}/field/plate", color=SKIN_COLOUR, dimensions=(*size, 5e-4), opacity=0.35)
            corners = np.array([[x, y, 0] for x in (-0.5, 0.5) for y in (-0.5, 0.5)]) * PAD_WINDOW
            lines = np.stack([corners, corners + np.array([0, 0, lift])], 1)
            scene.add_line_segments(f"{name}/field/edges", lines, SKIN_COLOUR, thickness=3e-4)

    def draw(self, board: Board, readings: Mapping[str, Reading], scale: float) -> None:
        """Draw the field of some readings, each in its colour.

        Args:
            board: Board of the chips.
            readings: Readings (uT) by name, with standard deviations of 0 where they have none.
            scale: Field (uT) that is drawn as long as in the pictures.
        """
        chips = np.asarray(board.chips, np.float64) * (1, 1, 0)
        if len(readings) != self._sets:
            self.clear()
        self._sets = len(readings)
        for number, (reading, colour) in enumerate(zip(readings.values(), CURVE_COLOURS, strict=False)):
            name = f"{self._name}/field/{number}"
            seen = np.isfinite(reading.mean).reshape(-1, 3).all(1)
            mean = np.nan_to_num(np.asarray(reading.mean, np.float64))
            vectors, covariance = drawn_field(board, mean, np.nan_to_num(reading.std), arrow_mm(board) / scale)
            self._draw(name, chips[seen], vectors[seen] / MM_PER_M, covariance[seen] / MM_PER_M**2, colour)

    def clear(self) -> None:
        """Remove the drawn field."""
        for number in range(self._sets):
            for part in ("arrows", "discs", "std"):
                self._scene.remove_by_name(f"{self._name}/field/{number}/{part}")

    def _draw(self, name: str, chips: np.ndarray, vectors: np.ndarray, covariance: np.ndarray, colour: str) -> None:
        rgb = np.array(255 * np.array(to_rgb(colour)), np.uint8)
        tips, upright = chips + vectors + 1e-7, np.tile([1.0, 0, 0, 0], (len(chips), 1))
        squares, axes = np.linalg.eigh(covariance)
        axes[:, :, 0] *= np.linalg.det(axes)[:, None]
        normal = np.maximum(abs(vectors[:, 2]) / 2, 1e-6)
        shades = np.where(vectors[:, 2:] > 0, rgb, 128 + rgb // 2)
        head = min(8e-4, 0.4 * float(np.linalg.norm(vectors, axis=1).max(initial=1e-6)))  # m, its length
        self._scene.add_arrows(
            f"{name}/arrows",
            np.stack([chips, tips], 1),
            rgb,
            shaft_radius=head / 3,
            head_radius=0.75 * head,
            head_length=head,
        )
        discs = {"batched_scales": np.stack([normal, normal, np.full_like(normal, 2e-3)], 1), "batched_colors": shades}
        balls = {"batched_scales": np.sqrt(np.maximum(squares, 1e-14)), "batched_colors": rgb}
        for part, shape, turns, at, options in (
            ("discs", DISC, upright, chips, discs), ("std", BALL, quaternions(axes), tips, balls)
        ):  # fmt: skip
            self._scene.add_batched_meshes_simple(
                f"{name}/{part}", shape.vertices, shape.faces, turns, at, opacity=0.35, lod="off", **options
            )
