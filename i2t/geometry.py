"""Rigid motions as 4 x 4 matrices: exponential, logarithm, inverse, composition and the frames of contact.

`T_a_b` maps points in b to a (frames as in `i2t.types`). Rotation vectors follow Rodrigues' formula, with series
near zero, so that values and derivatives stay finite there (Grassia, "Practical parameterization of rotations using the
exponential map", 1998); logarithms go through the largest component of the quaternion (Shepperd, "Quaternion from
rotation matrix", 1978). `exp` and `log` are those of SE(3) (Murray, Li and Sastry, "A mathematical introduction to
robotic manipulation", 1994); what an optimiser moves by is a *twist* as in `from_twist`, whose translation and rotation
do not mix and which is in metres throughout.

All but `random_motion` and `nearest_rigid` take NumPy or JAX arrays and give back the same kind: on the host in the
precision given, on a device `full_precision`, because an accelerator may otherwise round the factors of a product to 10
bits, half a millimetre at arm's length. JAX is not imported here, so that drivers can use the same formulas.
"""

import functools
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Key

from i2t.patches.dimensions import LAST_ROW_TOLERANCE, ORTHOGONALITY_TOLERANCE, TWIST_LEVER_M
from i2t.types import Array

SMALL_ANGLE_SQUARE = 1e-8  # rad^2, below which a series of two terms takes the place of a quotient
SMALL_SERIES_SQUARE = 1e-4  # rad^2, below which one of three terms does

Function = TypeVar("Function", bound=Callable[..., Any])


def full_precision(function: Function) -> Function:
    """Decorate a function that multiplies poses: JAX computes its products in full precision.

    Args:
        function: Any function of arrays.

    Returns:
        The same function, traced and run with the matmul precision "highest".
    """

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        jax = sys.modules.get("jax")  # where nobody has imported it, arrays are NumPy's
        if jax is None:
            return function(*args, **kwargs)
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return wrapped  # type: ignore[return-value]  # a wrapper has its function's signature


def transform(rotation: Float[Array, "3 3"], translation: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """Build T_a_b.

    Args:
        rotation: R_a_b.
        translation: The position (m) of b's origin in a.

    Returns:
        The rigid motion as one matrix.
    """
    xp = _namespace(rotation, translation)
    if xp is np:
        T_a_b = np.eye(4, dtype=np.result_type(rotation, translation))
        T_a_b[:3, :3], T_a_b[:3, 3] = rotation, translation
        return T_a_b
    return xp.eye(4).at[:3, :3].set(rotation).at[:3, 3].set(translation)


@full_precision
def inverse(T_a_b: Float[Array, "*n 4 4"]) -> Float[Array, "*n 4 4"]:
    """Invert rigid motions.

    Args:
        T_a_b: Rigid motions.

    Returns:
        T_b_a.
    """
    R_b_a = T_a_b[..., :3, :3].swapaxes(-1, -2)
    if T_a_b.ndim == 2:
        return transform(R_b_a, -R_b_a @ T_a_b[:3, 3])
    return _stacked(R_b_a, -R_b_a @ T_a_b[..., :3, 3:])


@full_precision
def compose(T_a_b: Float[Array, "*#n 4 4"], T_b_c: Float[Array, "*#n 4 4"]) -> Float[Array, "*n 4 4"]:
    """Chain two motions.

    Args:
        T_a_b: Rigid motions.
        T_b_c: Rigid motions.

    Returns:
        T_a_c.
    """
    return T_a_b @ T_b_c


@full_precision
def apply(T_a_b: Float[Array, "4 4"], points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Move points.

    Args:
        T_a_b: A rigid motion.
        points: Points (m) in b.

    Returns:
        The same points (m) in a.
    """
    xp = _namespace(T_a_b, points)
    return points @ T_a_b[:3, :3].T + xp.broadcast_to(T_a_b[:3, 3], points.shape)


def nearest_rigid(matrix: Float[Array, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Nearest rigid motion in float64 to one that single precision or a person rounded.

    Args:
        matrix: Nearly a rigid motion, a NumPy array or one that can be read as such.

    Returns:
        The same translation (m), and the rotation that is nearest in the sum of squares.
    """
    exact = np.asarray(matrix, np.float64)
    u, _, vt = np.linalg.svd(exact[:3, :3])
    return transform(u @ vt, exact[:3, 3])


def is_rigid(T_a_b: Float[Array, "4 4"]) -> Bool[Array, ""]:
    """Tell a rigid motion from any other matrix, traced ones too; `i2t.validation.pose` says what is wrong.

    Args:
        T_a_b: Any matrix.

    Returns:
        Whether it is a rotation (within `ORTHOGONALITY_TOLERANCE` of `i2t.patches.dimensions`) and a translation, all
        finite.
    """
    xp = _namespace(T_a_b)
    x, y, z = T_a_b[:3, :3].T
    products = xp.stack([xp.sum(x * x) - 1, xp.sum(y * y) - 1, xp.sum(x * y), *(xp.cross(x, y) - z)])
    last = xp.all(xp.abs(T_a_b[3] - xp.array([0, 0, 0, 1], T_a_b.dtype)) <= LAST_ROW_TOLERANCE)
    return xp.all(xp.abs(products) <= ORTHOGONALITY_TOLERANCE) & xp.all(xp.isfinite(T_a_b[:3, 3])) & last


@full_precision
def so3_exp(rotvec: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Rotation matrices of rotation vectors (Rodrigues' formula).

    Args:
        rotvec: Axis times angle (rad).

    Returns:
        The rotation matrices.
    """
    xp = _namespace(rotvec)
    square = rotvec @ rotvec if rotvec.ndim == 1 else xp.sum(rotvec * rotvec, -1)
    small = square < SMALL_ANGLE_SQUARE
    angle = xp.sqrt(xp.where(small, 1.0, square))
    sine = xp.where(small, 1 - square / 6, xp.sin(angle) / angle)
    cosine = xp.where(small, 0.5 - square / 24, (1 - xp.cos(angle)) / xp.where(small, 1.0, square))
    cross = _cross_matrix(rotvec)
    return xp.eye(3, dtype=rotvec.dtype) + sine[..., None, None] * cross + cosine[..., None, None] * cross @ cross


def so3_log(rotation: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3"]:
    """Rotation vectors of rotation matrices, the inverse of `so3_exp` for angles up to pi.

    Args:
        rotation: Rotation matrices.

    Returns:
        Axis times angle (rad), the angle from 0 to pi.
    """
    xp = _namespace(rotation)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = ([rotation[..., row, column] for column in range(3)] for row in range(3))
    products = [  # 4 q q', q = (w, x, y, z): the row with the largest diagonal is the one that is best known
        [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
    ]
    outer = xp.stack([xp.stack(row, -1) for row in products], -2)
    largest = xp.argmax(xp.stack([products[i][i] for i in range(4)], -1), -1)
    row = xp.take_along_axis(outer, largest[..., None, None], -2)[..., 0, :]
    row = row / xp.sqrt(xp.sum(row * row, -1, keepdims=True))
    row = xp.where(row[..., :1] < 0, -row, row)
    w, v = row[..., 0], row[..., 1:]
    square = xp.sum(v * v, -1)
    small = square < SMALL_ANGLE_SQUARE
    sine = xp.sqrt(xp.where(small, 1.0, square))
    near_one = xp.where(small, w, 1.0)
    scale = xp.where(small, 2 / near_one * (1 - square / (3 * near_one**2)), 2 * xp.arctan2(sine, w) / sine)
    return scale[..., None] * v


@full_precision
def exp(twist: Float[Array, "*n 6"]) -> Float[Array, "*n 4 4"]:
    """The exponential of SE(3): the motion of a constant velocity over one unit of time.

    Args:
        twist: Velocity (m) of the moving frame along its own axes, then its rotation vector (rad).

    Returns:
        Rigid motions; `log` is the inverse.
    """
    rotation = so3_exp(twist[..., 3:])
    translation = _left_jacobian(twist[..., 3:]) @ twist[..., :3, None]
    return _stacked(rotation, translation)


@full_precision
def log(T_a_b: Float[Array, "*n 4 4"]) -> Float[Array, "*n 6"]:
    """The logarithm of SE(3), the inverse of `exp` for angles below pi.

    Motions that leave a plane, ball or cylinder unchanged have logarithms without any part in the directions that can
    be seen on it.

    Args:
        T_a_b: Rigid motions.

    Returns:
        Velocity (m), then rotation vector (rad).
    """
    xp = _namespace(T_a_b)
    rotvec = so3_log(T_a_b[..., :3, :3])
    velocity = xp.linalg.solve(_left_jacobian(rotvec), T_a_b[..., :3, 3:])[..., 0]
    return xp.concatenate([velocity, rotvec], -1)


def from_twist(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """The rigid motion of a twist: first its rotation, then its translation, which do not mix.

    Args:
        twist: Three translations (m), then a rotation vector times `TWIST_LEVER_M` of `i2t.patches.dimensions`: how far
            it moves the rim of a patch, so that all six are in metres.

    Returns:
        The motion; `to_twist` is the inverse.
    """
    return transform(so3_exp(twist[3:] / TWIST_LEVER_M), twist[:3])


def to_twist(T_a_b: Float[Array, "*n 4 4"]) -> Float[Array, "*n 6"]:
    """The twists of rigid motions, as in `from_twist`.

    Args:
        T_a_b: Rigid motions.

    Returns:
        Three translations (m), then the rotation vector times `i2t.patches.dimensions.TWIST_LEVER_M` (m).
    """
    xp = _namespace(T_a_b)
    return xp.concatenate([T_a_b[..., :3, 3], TWIST_LEVER_M * so3_log(T_a_b[..., :3, :3])], -1)


@full_precision
def contact_frame(
    point: Float[Array, "3"], normal: Float[Array, "3"], roll: Float[Array, ""] | float = 0.0
) -> Float[Array, "4 4"]:
    """Frame of a skin flat on a surface.

    Roll 0 turns the frame whose tool points straight down and whose x is the world's by the smallest rotation (the
    paper's alignment); straight up, where that rotation is not unique, it turns about the world's x.

    Args:
        point: The tool's origin (m).
        normal: The surface's outward unit normal; tool z is minus it.
        roll: Angle (rad) by which the frame is turned about tool z.

    Returns:
        T_w_t of the tool.
    """
    xp = _namespace(point, normal, roll)
    z = -normal
    # Smallest rotation from down = (0, 0, -1) to z: I + [v] + [v]^2 / (1 + c) with v = down x z, c = down . z.
    c = -z[2]
    v = xp.stack([z[1], -z[0], xp.zeros_like(z[0])])
    cross = _cross_matrix(v)
    square = v @ v  # (1 - c)(1 + c), which still knows 1 + c where the sum has lost it to rounding
    upright = (square < 1e-12) & (c < 0)
    scale = xp.where(c > 0, 1 / xp.where(c > 0, 1 + c, 1.0), (1 - c) / xp.where(square < 1e-12, 1.0, square))
    turn = xp.eye(3, dtype=normal.dtype) + cross + scale * cross @ cross
    turn = xp.where(upright, xp.diag(xp.array([1.0, -1.0, -1.0], normal.dtype)), turn)
    down = xp.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]], normal.dtype)  # R_w_t of the tool straight down
    about_z = so3_exp(xp.stack([0.0 * c, 0.0 * c, xp.asarray(roll, c.dtype)]))
    return transform(turn @ down @ about_z, point)


def random_motion(
    key: Key[Array, ""], distance: float | Float[Array, ""], angle: float | Float[Array, ""]
) -> Float[Array, "4 4"]:
    """Draw a small rigid motion.

    Args:
        key: A JAX key.
        distance: Standard deviation (m) of the translation along each axis.
        angle: Standard deviation (rad) of the rotation vector along each axis.

    Returns:
        The motion, a JAX array.
    """
    import jax  # the one function that needs it

    drawn = jax.random.normal(key, (6,))  # one draw: XLA compiles each for half a second
    return transform(so3_exp(angle * drawn[3:]), distance * drawn[:3])


def _namespace(*arrays: Any) -> Any:
    """`jax.numpy` where one of the arrays is JAX's, traced or not, else NumPy."""
    jax = sys.modules.get("jax")
    return jax.numpy if jax is not None and any(isinstance(array, jax.Array) for array in arrays) else np


def _stacked(rotation: Float[Array, "*n 3 3"], translation: Float[Array, "*n 3 1"]) -> Float[Array, "*n 4 4"]:
    """Rigid motions from their parts."""
    xp = _namespace(rotation, translation)
    top = xp.concatenate([rotation, translation], -1)
    last = xp.broadcast_to(xp.array([0, 0, 0, 1], top.dtype), (*top.shape[:-2], 1, 4))
    return xp.concatenate([top, last], -2)


def _cross_matrix(vector: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """The matrix [v] whose product with w is v x w."""
    xp = _namespace(vector)
    x, y, z = (vector[..., i] for i in range(3))
    zero = xp.zeros_like(x)
    rows = [zero, -z, y], [z, zero, -x], [-y, x, zero]
    return xp.stack([xp.stack(row, -1) for row in rows], -2)


def _left_jacobian(rotvec: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """The integral of the rotation along a motion of constant velocity, from 0 to 1."""
    xp = _namespace(rotvec)
    square = xp.sum(rotvec * rotvec, -1)
    small = square < SMALL_SERIES_SQUARE
    safe = xp.where(small, 1.0, square)
    angle = xp.sqrt(safe)
    first = xp.where(small, 0.5 - square / 24 + square**2 / 720, (1 - xp.cos(angle)) / safe)
    second = xp.where(small, 1 / 6 - square / 120 + square**2 / 5040, (angle - xp.sin(angle)) / (safe * angle))
    cross = _cross_matrix(rotvec)
    return xp.eye(3, dtype=rotvec.dtype) + first[..., None, None] * cross + second[..., None, None] * cross @ cross
