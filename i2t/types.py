"""Types that all parts of i2t share: surfaces, patches, boards, pads and touches.

Frames are W (world), B (robot base), T (tool), C (camera) and O (object); `T_a_b` is the `(4, 4)` transform that maps
points in b to a. The tool frame has its origin at the centre of the skin's surface, z pointing out of the skin into the
object, and x and y along the skin's edges. Units are metres, radians, newtons and tesla inside the physics, and
microtesla for readings.

Every type is a NamedTuple of arrays and therefore a JAX pytree. A single example has the shapes given here, and a batch
has a leading axis. The arrays may be NumPy's or JAX's. This module does not import JAX, so that the hardware layer can
use the same types.
"""

from enum import IntEnum
from typing import Any, NamedTuple, TypeAlias, TypeVar

from jaxtyping import Float, Int

Array: TypeAlias = Any  # a NumPy or a JAX array
Kind = TypeVar("Kind", bound=tuple)


def one_line(values: tuple) -> str:
    """Describe a named tuple of arrays by their shapes and types instead of their numbers.

    Args:
        values: The named tuple.

    Returns:
        One line of text, such as `Patch(depth=48x48 float32, nearest=0.001)`.
    """
    parts = [f"{name}={shown(value)}" for name, value in values._asdict().items()]  # type: ignore[attr-defined]
    return f"{type(values).__name__}({', '.join(parts)})"


def in_one_line(kind: type[Kind]) -> type[Kind]:
    """Decorate a class of named tuples so that `repr` shows it by `one_line`.

    Args:
        kind: The class to decorate.

    Returns:
        The same class, with another `__repr__`.
    """
    kind.__repr__ = one_line  # type: ignore[method-assign,assignment]  # it is given a named tuple
    return kind


def shown(value: Any) -> str:
    """Describe one field by its number, by the shape and type of its array, or by another short text.

    Args:
        value: Value of the field.

    Returns:
        Text of at most 160 characters, without line breaks.
    """
    shape = getattr(value, "shape", None)
    if shape == () and hasattr(value, "item") and "Tracer" not in type(value).__name__:
        return f"{value.item():.6g}" if hasattr(value, "dtype") and value.dtype.kind in "fiu" else str(value)
    if isinstance(shape, tuple):
        return f"{'x'.join(map(str, shape)) or 'scalar'} {getattr(value, 'dtype', '')}".rstrip()
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple | list | dict) and len(value) > 8:
        return f"{type(value).__name__} of {len(value)}"
    text = one_line(value) if hasattr(value, "_fields") else " ".join(repr(value).split())
    return text if len(text) <= 160 else f"{type(value).__name__}(...)"


@in_one_line
class Surface(NamedTuple):
    """A triangle mesh prepared for rendering, in the object's frame; `i2t.prepare_surface` makes it.

    Faces are sorted by a k-d tree into clusters, with 32 clusters to a group. Degenerate faces pad the mesh to one of a
    few sizes, so that surfaces of one size share a compiled renderer and can be stacked. Boxes are stored as centres
    and half extents. Only rendering needs the boxes and groups.

    Example:
        surface = i2t.prepare_surface(i2t.load_mesh("mug.stl", unit="m"))
        patch = i2t.render_patch(surface, T_o_t)
    """

    triangles: Float[Any, "*batch faces 3 3"]  # m, corners of each face
    boxes: Float[Any, "*batch groups 6 32"] | None = None  # m, boxes of the 32 clusters of each group
    groups: Float[Any, "*batch 6 words"] | None = None  # m, boxes of the groups, padded to a multiple of 32


@in_one_line
class Patch(NamedTuple):
    """Depth patch: an image of the depth (m) in front of the skin behind the nearest surface point, and the position
    (m) of that point along tool z. Rows run along tool y and columns along tool x, with pixel centres at
    ((k + 0.5)/n - 0.5) times the window's edge.

    Example:
        patch = i2t.render_patch(surface, T_o_t)
        height = patch.nearest + patch.depth  # m, of the surface along tool z
    """

    depth: Float[Any, "*batch n n"]  # m behind the nearest surface point, at most the reach (also without a surface)
    nearest: Float[Any, "*batch"]  # m, position of that point along tool z from the tool origin; +inf without a surface


@in_one_line
class Board(NamedTuple):
    """Positions and axes of the magnetometer chips on a sensor board, in the tool frame.

    A board with n chips sends readings of 3 n values. `chips[i]` is the position of the i-th chip in the order in which
    the board sends its values. `rotations[i]` maps the axes of that chip to tool axes, and is a reflection if the
    driver flips a sign.

    Example:
        board = i2t.reskin_board()
        in_tool_axes = board.to_tool(reading)  # (15,) uT to (5, 3) uT
    """

    chips: Float[Any, "*batch chips 3"]  # m, in the tool frame; z is negative, below the skin's surface
    rotations: Float[Any, "*batch chips 3 3"]  # rotations from the axes of each chip to tool axes

    @property
    def num_chips(self) -> int:
        """Number of chips."""
        return int(self.chips.shape[-2])

    @property
    def num_readings(self) -> int:
        """Number of values in a reading, three for each chip."""
        return 3 * self.num_chips

    def to_tool(self, reading: Array) -> Array:
        """Rotate readings into tool axes.

        Args:
            reading: `(..., 3 n)` values in the board's order and the chips' own axes.

        Returns:
            `(..., n, 3)` field at each chip in tool axes, in the unit of the readings.
        """
        return (self.rotations @ reading.reshape(*reading.shape[:-1], self.num_chips, 3, 1))[..., 0]

    def to_board(self, field: Array) -> Array:
        """Rotate fields into readings as the board sends them, the inverse of `to_tool`.

        Args:
            field: `(..., n, 3)` field at each chip in tool axes.

        Returns:
            `(..., 3 n)` values in the board's order and the chips' own axes.
        """
        turned = (self.rotations.swapaxes(-1, -2) @ field[..., None])[..., 0]
        return turned.reshape(*field.shape[:-2], self.num_readings)


@in_one_line
class Pad(NamedTuple):
    """A magnetic skin, an unevenly magnetised elastic layer that is bonded to its board or clamped at its edge:
    thickness (m), Young's modulus (Pa), Poisson's ratio, magnetisation (A/m) of its cells, gains of the chips' axes,
    board, friction coefficient, and compliance (m/N) of the clamped centre.

    Example:
        pad = i2t.sample_pad(jax.random.key(0), board=i2t.anyskin_board())
        softer = pad._replace(young=0.8 * pad.young)
    """

    thickness: Float[Any, "*batch"]  # m
    young: Float[Any, "*batch"]  # Pa
    poisson: Float[Any, "*batch"]  # Poisson's ratio
    # A/m in tool axes on m x m equal cells of the pad (rows along y), uniform through the thickness
    magnetization: Float[Any, "*batch m m 3"]
    gains: Float[Any, "*batch c"]  # gain of each axis of each chip in the board's order; the nominal gain is 1
    board: Board  # the chips below the skin
    friction: Float[Any, "*batch"]  # Coulomb friction coefficient of the skin
    mount_compliance: Float[Any, "*batch"]  # m/N, sinking of the centre of a skin clamped at its edge; 0 if bonded

    def __str__(self) -> str:
        """Describe the layer, its magnetisation and the board."""
        cells = " x ".join(map(str, self.magnetization.shape[-3:-1]))
        return (
            f"Pad with {self.board.num_chips} chips, {cells} magnetised cells\n"
            f"  thickness {shown(self.thickness)} m, Young's modulus {shown(self.young)} Pa, Poisson's ratio "
            f"{shown(self.poisson)}\n"
            f"  friction {shown(self.friction)}, compliance of the mount {shown(self.mount_compliance)} m/N"
        )


@in_one_line
class Truth(NamedTuple):
    """Error-free values of n simulated touches, which a real lab cannot measure: view and nearest distance (m), force
    (N), indentation (m), and reading (uT) without noise or ambient.

    Example:
        touches = i2t.simulate_touches(jax.random.key(0), [surface], pad, errors, 100)
        if touches.truth is not None:  # it is None for recorded touches
            error = touches.reading - touches.truth.reading  # uT, of noise and ambient
    """

    view: Float[Any, "*n w w"]  # m, view (72 x 72) of the surface that the skin met, without camera or pose error
    nearest: Float[Any, "*n"]  # m, position of the nearest surface point along tool z at the end of the press
    force: Float[Any, "*n"]  # N
    indentation: Float[Any, "*n"]  # m, largest compression of the skin
    reading: Float[Any, "*n c"]  # uT, without noise or ambient


@in_one_line
class Touches(NamedTuple):
    """Touches, one in each row of every array: depth views (m), readings (uT), force (N), travel (m), poses and labels.

    NaN marks what was not measured. `nearest` (m) is the position of the nearest surface point along tool z at the end
    of the press. It is minus the travel of the press where camera and arm agree.

    Example:
        touches = i2t.load_dataset("data/stamps").touches
        hard = touches.reading[touches.force > 1.0]  # (n, 3 chips) uT, of presses above 1 N
    """

    patch: Float[Any, "*n p p"]  # m, 48 x 48, what the camera saw in the tool frame at the end of the press
    # m, 72 x 72, the patch with its surroundings, negative where something stands out before the patch's nearest
    # point; NaN where the recording was cropped
    view: Float[Any, "*n w w"]
    nearest: Float[Any, "*n"]  # m
    reading: Float[Any, "*n c"]  # uT, mean in contact minus ambient, in the board's order and axes; NaN: a missing chip
    force: Float[Any, "*n"]  # N, along tool z
    travel: Float[Any, "*n"]  # m, of the tool past first contact
    T_w_t: Float[Any, "*n 4 4"]  # tool pose at the end of the press, as the arm reports it
    T_w_o: Float[Any, "*n 4 4"]  # object pose as the lab believes it
    object: Int[Any, "*n"]  # index into the data set's object names
    pad: Int[Any, "*n"]  # index into the data set's pad names
    # index into the data set's session names (a session: a recording with one placement of an object)
    session: Int[Any, "*n"]
    code: Int[Any, "*n"]  # how the press ended, a `ReturnCode`
    truth: Truth | None = None  # values without errors and noise, if the touch is simulated
    time: Float[Any, "*n"] | None = None  # s, when, as the recording counts (Unix time where it has it); float64


class ReturnCode(IntEnum):
    """Code of how a press ended: by the skin's limit, the wrench's limit, or in the air (the paper's codes).

    Example:
        in_contact = touches.code != i2t.ReturnCode.AIR
    """

    FAILED = -1
    FREE = 0
    UNDEFINED = 1
    SKIN = 2
    WRENCH = 3
    AIR = 4
