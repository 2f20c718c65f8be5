"""Rigid motions as 4 x 4 matrices: exponential, logarithm, inverse, composition and the frames of contact.

`T_a_b` maps points in b to a (frames as in `i2t.types`). Rotation vectors follow Rodrigues' formula, with series near
zero that keep values and derivatives finite (Grassia, "Practical parameterization of rotations using the exponential
map", 1998). Logarithms go through the largest component of the quaternion (Shepperd, "Quaternion from rotation matrix",
1978). `exp` and `log` are those of SE(3) (Murray, Li and Sastry, "A mathematical introduction to robotic manipulation",
1994). Optimisers move poses by a *twist* (`from_twist`), whose translation and rotation are independent and both in
metres.

All functions except `random_motion` and `nearest_rigid` take NumPy or JAX arrays and return the same kind. On the host
they compute in the precision of their arguments, on a device in `full_precision`: an accelerator may otherwise round
the factors of a product to 10 bits, half a millimetre at arm's length. This module does not import JAX, so that drivers
can use the same formulas.
"""

import functools
import sys
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Key

from i2t.patches.dimensions import LAST_ROW_TOLERANCE, ORTHOGONALITY_TOLERANCE, TWIST_LEVER_M
from i2t.types import Array

# rad^2, squared angle below which a series of two terms replaces quotients such as sin(x) / x
TWO_TERM_SERIES_SQUARE = 1e-8

Function = TypeVar("Function", bound=Callable[..., Any])


def full_precision(function: Function) -> Function:
    """Decorate a function that multiplies poses, so that JAX computes its products in full precision.

    Args:
        function: Any function of arrays.

    Returns:
        The same function, traced and run with the matmul precision "highest".
    """

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        jax = sys.modules.get("jax")  # arrays are NumPy's as long as JAX has not been imported
        if jax is None:
            return function(*args, **kwargs)
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return wrapped  # type: ignore[return-value]  # a wrapper has its function's signature


def transform(rotation: Float[Array, "3 3"], translation: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """Build a rigid motion T_a_b from rotation and translation.

    Args:
        rotation: The rotation matrix R_a_b, which maps directions in b to a.
        translation: The position (m) of b's origin in a.

    Returns:
        `(4, 4)` matrix T_a_b.
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
        T_a_b: Rigid motions that map points in b to a.

    Returns:
        `(*n, 4, 4)` rigid motions T_b_a that map points in a to b.
    """
    R_b_a = T_a_b[..., :3, :3].swapaxes(-1, -2)
    if T_a_b.ndim == 2:
        return transform(R_b_a, -R_b_a @ T_a_b[:3, 3])
    return _stacked(R_b_a, -R_b_a @ T_a_b[..., :3, 3:])


@full_precision
def compose(T_a_b: Float[Array, "*#n 4 4"], T_b_c: Float[Array, "*#n 4 4"]) -> Float[Array, "*n 4 4"]:
    """Compose rigid motions: T_a_c = T_a_b T_b_c.

    Args:
        T_a_b: Rigid motions that map points in b to a.
        T_b_c: Rigid motions that map points in c to b.

    Returns:
        `(*n, 4, 4)` rigid motions T_a_c that map points in c to a.
    """
    return T_a_b @ T_b_c


@full_precision
def apply(T_a_b: Float[Array, "4 4"], points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Transform points by a rigid motion.

    Args:
        T_a_b: A rigid motion that maps points in b to a.
        points: Points (m) in b.

    Returns:
        `(*n, 3)` coordinates (m) of the same points in a.
    """
    xp = _namespace(T_a_b, points)
    return points @ T_a_b[:3, :3].T + xp.broadcast_to(T_a_b[:3, 3], points.shape)


def nearest_rigid(matrix: Float[Array, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Restore a rigid motion that was rounded, by single precision or by hand.

    Args:
        matrix: A nearly rigid motion, as a NumPy array or anything that converts to one.

    Returns:
        `(4, 4)` float64 rigid motion with the same translation (m) and the nearest rotation in the sum of squares.
    """
    exact = np.asarray(matrix, np.float64)
    u, _, vt = np.linalg.svd(exact[:3, :3])
    return transform(u @ vt, exact[:3, 3])


def is_rigid(T_a_b: Float[Array, "4 4"]) -> Bool[Array, ""]:
    """Test whether a matrix is a rigid motion. It may be traced by JAX; `i2t.validation.pose` explains what is wrong.

    Args:
        T_a_b: Any matrix.

    Returns:
        True if the matrix is a rotation (within `ORTHOGONALITY_TOLERANCE` of `i2t.patches.dimensions`) and a
        translation, all finite.
    """
    xp = _namespace(T_a_b)
    x, y, z = T_a_b[:3, :3].T
    products = xp.stack([xp.sum(x * x) - 1, xp.sum(y * y) - 1, xp.sum(x * y), *(xp.cross(x, y) - z)])
    last = xp.all(xp.abs(T_a_b[3] - xp.array([0, 0, 0, 1], T_a_b.dtype)) <= LAST_ROW_TOLERANCE)
    return xp.all(xp.abs(products) <= ORTHOGONALITY_TOLERANCE) & xp.all(xp.isfinite(T_a_b[:3, 3])) & last


@full_precision
def so3_exp(rotvec: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Convert rotation vectors to rotation matrices (Rodrigues' formula).

    Args:
        rotvec: Axis times angle (rad).

    Returns:
        `(*n, 3, 3)` rotation matrices.
    """
    xp = _namespace(rotvec)
    square = rotvec @ rotvec if rotvec.ndim == 1 else xp.sum(rotvec * rotvec, -1)
    small = square < TWO_TERM_SERIES_SQUARE
    angle = xp.sqrt(xp.where(small, 1.0, square))
    sine = xp.where(small, 1 - square / 6, xp.sin(angle) / angle)
    cosine = xp.where(small, 0.5 - square / 24, (1 - xp.cos(angle)) / xp.where(small, 1.0, square))
    cross = _cross_matrix(rotvec)
    return xp.eye(3, dtype=rotvec.dtype) + sine[..., None, None] * cross + cosine[..., None, None] * cross @ cross


def so3_log(rotation: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3"]:
    """Convert rotation matrices to rotation vectors, the inverse of `so3_exp` for angles up to pi.

    Args:
        rotation: Rotation matrices.

    Returns:
        `(*n, 3)` axes times angles (rad), with angles from 0 to pi.
    """
    xp = _namespace(rotation)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = ([rotation[..., row, column] for column in range(3)] for row in range(3))
    products = [  # 4 q q' with q = (w, x, y, z); the row with the largest diagonal suffers least from rounding
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
    small = square < TWO_TERM_SERIES_SQUARE
    sine = xp.sqrt(xp.where(small, 1.0, square))
    near_one = xp.where(small, w, 1.0)
    scale = xp.where(small, 2 / near_one * (1 - square / (3 * near_one**2)), 2 * xp.arctan2(sine, w) / sine)
    return scale[..., None] * v


@full_precision
def exp(twist: Float[Array, "*n 6"]) -> Float[Array, "*n 4 4"]:
    """Compute the SE(3) exponential: the rigid motion at a constant velocity over one unit of time.

    Args:
        twist: Velocity (m per unit of time) of the moving frame along its own axes, followed by its angular velocity
            (rad per unit of time).

    Returns:
        `(*n, 4, 4)` rigid motions.
    """
    rotation = so3_exp(twist[..., 3:])
    translation = _left_jacobian(twist[..., 3:]) @ twist[..., :3, None]
    return _stacked(rotation, translation)


@full_precision
def log(T_a_b: Float[Array, "*n 4 4"]) -> Float[Array, "*n 6"]:
    """Compute the SE(3) logarithm of rigid motions, the inverse of `exp` for angles below pi.

    The logarithm of a motion that maps a plane, ball or cylinder onto itself has no component in the directions in
    which that shape constrains a pose.

    Args:
        T_a_b: Rigid motions.

    Returns:
        `(*n, 6)` velocities (m per unit of time), followed by angular velocities (rad per unit of time), as for `exp`.
    """
    xp = _namespace(T_a_b)
    rotvec = so3_log(T_a_b[..., :3, :3])
    velocity = xp.linalg.solve(_left_jacobian(rotvec), T_a_b[..., :3, 3:])[..., 0]
    return xp.concatenate([velocity, rotvec], -1)


def from_twist(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """Convert a twist to a rigid motion, whose translation and rotation are independent; the inverse of `to_twist`.

    Args:
        twist: Three translations (m), followed by a rotation vector times `TWIST_LEVER_M` of `i2t.patches.dimensions`.
            The product is the distance by which the rotation moves the rim of a patch, so that all six are in metres.

    Returns:
        `(4, 4)` rigid motion.
    """
    return transform(so3_exp(twist[3:] / TWIST_LEVER_M), twist[:3])


def to_twist(T_a_b: Float[Array, "*n 4 4"]) -> Float[Array, "*n 6"]:
    """Convert rigid motions to twists, the inverse of `from_twist`.

    Args:
        T_a_b: Rigid motions.

    Returns:
        `(*n, 6)` twists (m): three translations, followed by the rotation vector times `TWIST_LEVER_M` of
        `i2t.patches.dimensions`.
    """
    xp = _namespace(T_a_b)
    return xp.concatenate([T_a_b[..., :3, 3], TWIST_LEVER_M * so3_log(T_a_b[..., :3, :3])], -1)


@full_precision
def contact_frame(
    point: Float[Array, "3"], normal: Float[Array, "3"], roll: Float[Array, ""] | float = 0.0
) -> Float[Array, "4 4"]:
    """Compute the tool pose at which a skin is flat on a surface point.

    With roll 0, the pose is that of a tool which points straight down with its x along the world's x, turned onto the
    normal by the smallest rotation (the paper's alignment). For a tool that points straight up, where that rotation is
    not unique, it is a rotation about the world's x.

    Args:
        point: The surface point (m) in the world frame, which becomes the tool's origin.
        normal: The surface's outward unit normal, opposite to tool z.
        roll: Additional rotation (rad) about tool z.

    Returns:
        `(4, 4)` tool pose T_w_t.
    """
    xp = _namespace(point, normal, roll)
    z = -normal
    # Smallest rotation from down = (0, 0, -1) to z: I + [v] + [v]^2 / (1 + c) with v = down x z, c = down . z.
    c = -z[2]
    v = xp.stack([z[1], -z[0], xp.zeros_like(z[0])])
    cross = _cross_matrix(v)
    square = v @ v  # (1 - c)(1 + c), which keeps the digits of 1 + c that the sum loses to rounding
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
    """Draw a random small rigid motion from normal distributions.

    Args:
        key: The JAX key to draw with.
        distance: Standard deviation (m) of the translation along each axis.
        angle: Standard deviation (rad) of the rotation vector along each axis.

    Returns:
        `(4, 4)` rigid motion, a JAX array.
    """
    import jax  # no other function of this module needs it

    normal = jax.random.normal(key, (6,))  # a single draw, because XLA takes half a second to compile each
    return transform(so3_exp(angle * normal[3:]), distance * normal[:3])


def _namespace(*arrays: Any) -> Any:
    """Choose `jax.numpy` if any array is JAX's, traced or not, else NumPy."""
    jax = sys.modules.get("jax")
    return jax.numpy if jax is not None and any(isinstance(array, jax.Array) for array in arrays) else np


def _stacked(rotation: Float[Array, "*n 3 3"], translation: Float[Array, "*n 3 1"]) -> Float[Array, "*n 4 4"]:
    """Stack rotations and translations to rigid motions."""
    xp = _namespace(rotation, translation)
    top = xp.concatenate([rotation, translation], -1)
    last = xp.broadcast_to(xp.array([0, 0, 0, 1], top.dtype), (*top.shape[:-2], 1, 4))
    return xp.concatenate([top, last], -2)


def _cross_matrix(vector: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Build the matrix [v] whose product with w is v x w."""
    xp = _namespace(vector)
    x, y, z = (vector[..., i] for i in range(3))
    zero = xp.zeros_like(x)
    rows = [zero, -z, y], [z, zero, -x], [-y, x, zero]
    return xp.stack([xp.stack(row, -1) for row in rows], -2)


def _left_jacobian(rotvec: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Integrate the rotation of a motion at constant angular velocity over one unit of time."""
    xp = _namespace(rotvec)
    square = xp.sum(rotvec * rotvec, -1)
    small = square < 1e-4  # rad^2; below, a series of three terms replaces quotients such as (1 - cos(x)) / x^2
    safe = xp.where(small, 1.0, square)
    angle = xp.sqrt(safe)
    first = xp.where(small, 0.5 - square / 24 + square**2 / 720, (1 - xp.cos(angle)) / safe)
    second = xp.where(small, 1 / 6 - square / 120 + square**2 / 5040, (angle - xp.sin(angle)) / (safe * angle))
    cross = _cross_matrix(rotvec)
    return xp.eye(3, dtype=rotvec.dtype) + first[..., None, None] * cross + second[..., None, None] * cross @ cross
