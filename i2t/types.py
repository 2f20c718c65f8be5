"""Types of every part of i2t: surfaces, boards, pads, touches and the numbers of a depth patch.

Frames: W world, B robot base, T tool, C camera, O object; `T_a_b` is the (4, 4) transform that maps points in b to a.
The tool frame has its origin at the skin's centre on its surface, z out of the skin into the object, x and y along the
skin's edges. Units: metres, radians, newtons and tesla in the physics, microtesla at the sensor's face.

Every type is a NamedTuple of arrays and so a JAX pytree: one example has the shapes given here, a batch has a leading
axis. NumPy and JAX arrays are both welcome, and nothing here imports JAX, so that the hardware layer can speak the same
words.
"""

from enum import IntEnum
from typing import Any, NamedTuple, TypeAlias, TypeVar

from jaxtyping import Float, Int

Array: TypeAlias = Any  # a NumPy or a JAX array
Kind = TypeVar("Kind", bound=tuple)
MAX_SHOWN_ITEMS, MAX_SHOWN_TEXT = 8, 160  # items of a container, and characters, that one line of a `repr` shows


def one_line(values: tuple) -> str:
    """Text of a named tuple of arrays: shapes and types in place of numbers.

    Args:
        values: The named tuple.

    Returns:
        One line.
    """
    parts = [f"{name}={_shown(value)}" for name, value in values._asdict().items()]  # type: ignore[attr-defined]
    return f"{type(values).__name__}({', '.join(parts)})"


def in_one_line(kind: type[Kind]) -> type[Kind]:
    """Let a class of named tuples show itself by `one_line`.

    Args:
        kind: The class.

    Returns:
        The class.
    """
    kind.__repr__ = one_line  # type: ignore[method-assign,assignment]  # it is given a named tuple
    return kind


def _shown(value: Any) -> str:
    """Text of one field: a number, the shape and type of an array, or another short description."""
    shape = getattr(value, "shape", None)
    if shape == () and hasattr(value, "item") and "Tracer" not in type(value).__name__:
        return f"{value.item():.6g}" if hasattr(value, "dtype") and value.dtype.kind in "fiu" else str(value)
    if isinstance(shape, tuple):
        return f"{'x'.join(map(str, shape)) or 'scalar'} {getattr(value, 'dtype', '')}".rstrip()
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple | list | dict) and len(value) > MAX_SHOWN_ITEMS:
        return f"{type(value).__name__} of {len(value)}"
    text = one_line(value) if hasattr(value, "_fields") else " ".join(repr(value).split())
    return text if len(text) <= MAX_SHOWN_TEXT else f"{type(value).__name__}(...)"


@in_one_line
class Surface(NamedTuple):
    """A triangle mesh ready for rendering, in the object's frame; build it with `i2t.rendering.render.prepare_surface`.

    Faces lie in the order of a k-d tree, a few to a cluster and 32 clusters to a group, padded with faces that shrink
    to a point up to a static size class, so that surfaces of one class share a compiled renderer and can be stacked. A
    box is its centre and its half extents. Triangles alone are enough for everything but rendering.

    Example:
        surface = i2t.prepare_surface(i2t.load_mesh("mug.stl", unit="m"))
        patch = i2t.render_patch(surface, T_o_t)
    """

    triangles: Float[Any, "*batch faces 3 3"]  # m, of each face's 3 corners
    boxes: Float[Any, "*batch groups 6 32"] | None = None  # m, of 32 clusters
    groups: Float[Any, "*batch 6 words"] | None = None  # m; groups rounded up to whole words of 32


@in_one_line
class Patch(NamedTuple):
    """Depth in front of the skin, seen along tool z: row i along tool y, column j along tool x, pixel centres at ((k +
    0.5)/n - 0.5) window.

    Example:
        patch = i2t.render_patch(surface, T_o_t)
        height = patch.nearest + patch.depth  # m, of the surface along tool z
    """

    depth: Float[Any, "*batch n n"]  # m behind the nearest surface point, clipped to the reach; no surface = reach
    nearest: Float[Any, "*batch"]  # m, signed distance of that point from the tool origin along tool z; +inf for none


@in_one_line
class Board(NamedTuple):
    """A sensor board: positions of its chips below the skin and their axes in the tool frame.

    A board has n chips and sends readings of 3 n values. `chips[i]` is the i-th chip in the order in which the board
    sends its values, `rotations[i]` maps that chip's axes to tool axes (a reflection where a driver flips a sign).

    Example:
        board = i2t.reskin_board()
        in_tool_axes = board.to_tool(reading)  # (15,) uT to (5, 3) uT
    """

    chips: Float[Any, "*batch chips 3"]  # m, in the tool frame; z is negative, below the skin's surface
    rotations: Float[Any, "*batch chips 3 3"]  # from each chip's axes to the tool's

    @property
    def num_chips(self) -> int:
        """Number n of chips."""
        return int(self.chips.shape[-2])

    @property
    def num_readings(self) -> int:
        """Values of one reading, 3 n."""
        return 3 * self.num_chips

    def to_tool(self, reading: Array) -> Array:
        """Turn readings into tool axes.

        Args:
            reading: (..., 3 n) in the board's order and the chips' own axes.

        Returns:
            (..., n, 3) in tool axes.
        """
        return (self.rotations @ reading.reshape(*reading.shape[:-1], self.num_chips, 3, 1))[..., 0]

    def to_board(self, field: Array) -> Array:
        """Turn fields into readings as the board sends them; the inverse of `to_tool`.

        Args:
            field: (..., n, 3) in tool axes.

        Returns:
            (..., 3 n) in the board's order and the chips' own axes.
        """
        turned = (self.rotations.swapaxes(-1, -2) @ field[..., None])[..., 0]
        return turned.reshape(*field.shape[:-2], self.num_readings)


@in_one_line
class Pad(NamedTuple):
    """One magnetic skin: an elastic layer, bonded to its board or clamped at its edge, magnetised unevenly.

    Example:
        pad = i2t.sample_pad(jax.random.key(0), board=i2t.anyskin_board())
        softer = pad._replace(young=0.8 * pad.young)
    """

    thickness: Float[Any, "*batch"]  # m
    young: Float[Any, "*batch"]  # Pa
    poisson: Float[Any, "*batch"]  # Poisson's ratio
    # A/m in tool axes on m x m equal cells of the pad (row along y), uniform through the thickness:
    magnetization: Float[Any, "*batch m m 3"]
    gains: Float[Any, "*batch c"]  # of the chips' axes, in the board's order; 1 is nominal
    board: Board  # the chips under it
    friction: Float[Any, "*batch"]  # coefficient of Coulomb friction of the skin; 0 is frictionless
    mount_compliance: Float[Any, "*batch"]  # m/N by which the middle of a skin clamped at its edge sinks; 0 is bonded


@in_one_line
class Truth(NamedTuple):
    """Truth of a simulated touch: the ceiling that an ideal observer would reach."""

    wide: Float[Any, "*n w w"]  # m, 72 x 72, the surface as the skin met it, without camera or pose error
    nearest: Float[Any, "*n"]  # m, at the stop, without error
    force: Float[Any, "*n"]  # N
    indentation: Float[Any, "*n"]  # m, of the skin
    reading: Float[Any, "*n c"]  # uT, without noise or ambient


@in_one_line
class Touches(NamedTuple):
    """Touches, one on each row of every array: views, readings, and measurements of the arm.

    NaN marks what was not measured. `nearest` is measured at the end of the press, so it is negative by the depth of
    the press where camera and arm agree.

    Example:
        touches = i2t.load_dataset("data/stamps").touches
        hard = touches.reading[touches.force > 1.0]  # (n, 3 chips) uT, of presses above 1 N
    """

    patch: Float[Any, "*n p p"]  # m, 48 x 48, what the camera saw in the tool frame at the end of the press
    # m, 72 x 72, the same view with its surroundings, negative where something stands out before the patch's nearest
    # point; NaN where the recording was cropped
    wide: Float[Any, "*n w w"]
    nearest: Float[Any, "*n"]  # m
    reading: Float[Any, "*n c"]  # uT, mean in contact minus ambient, in the board's order and axes; NaN: a missing chip
    force: Float[Any, "*n"]  # N, along tool z
    depth: Float[Any, "*n"]  # m, travel past first contact
    T_w_t: Float[Any, "*n 4 4"]  # tool pose at the end of the press, as the arm reports it
    T_w_o: Float[Any, "*n 4 4"]  # object pose as the lab believes it
    object: Int[Any, "*n"]  # index into the data set's object names
    pad: Int[Any, "*n"]  # index into its pad names
    session: Int[Any, "*n"]  # index into its session names (a session: a recording with one placement of an object)
    code: Int[Any, "*n"]  # a `ReturnCode`
    truth: Truth | None = None  # without errors and noise, where simulated
    time: Float[Any, "*n"] | None = None  # s, when, as the recording counts (Unix time where it has it); float64


class ReturnCode(IntEnum):
    """End of a press (the paper's codes)."""

    FAILED = -1
    FREE = 0
    UNDEFINED = 1
    SKIN = 2
    WRENCH = 3
    AIR = 4
