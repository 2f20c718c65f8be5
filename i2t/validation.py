"""Checks of the arguments that users pass to public functions: numbers, poses, counts and random keys.

A wrong type raises a TypeError and a wrong value a ValueError, with one sentence that names the argument. Values that
`jit`, `vmap` or a derivative traces have no number yet and are accepted.
"""

import math
import operator
import re
from typing import Any

import numpy as np

from i2t.errors import did_you_mean
from i2t.patches.dimensions import LAST_ROW_TOLERANCE, MAX_POSE_M, MAX_SKIN_FORCE_N, ORTHOGONALITY_TOLERANCE

ROUND_TIPS = ("sphere", "cylinder")  # shapes of indenters that are given by a radius
MIN_TIP_RADIUS_MM = 0.1  # mm, smallest accepted radius of a round tip; a smaller one was probably given in metres


def is_traced(*values: Any) -> bool:
    """Test whether JAX traces a value, which then has no number yet.

    Args:
        values: Values of any type.

    Returns:
        True if at least one of them is traced.
    """
    return any("Tracer" in type(value).__name__ for value in values)


def numbers(name: str, value: Any, hint: str) -> np.ndarray:
    """Convert a user's argument to an array of real numbers.

    Args:
        name: Name of the argument, for the message.
        value: A number, or an array or nested list of numbers.
        hint: What to give instead, for the message.

    Returns:
        Array of the argument's shape and type; masked floats become NaN.

    Raises:
        TypeError: The argument holds anything but real numbers, rows of different lengths, or masked integers.
    """
    value = _without_mask(name, value, hint)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:  # rows of different lengths
        raise TypeError(f"{name}: is a {type(value).__name__} that does not form an array; give {hint}") from error
    is_real = array.dtype.kind in "iuf"  # integers and floats, but not booleans, text or objects
    if array.size and not is_real:
        raise TypeError(f"{name}: is {_short(value)}, not real numbers; give {hint}")
    return array


def _without_mask(name: str, value: Any, hint: str) -> Any:
    """Replace masked entries of a masked array by NaN, and return any other value unchanged."""
    if not isinstance(value, np.ma.MaskedArray) or not np.ma.getmaskarray(value).any():
        return value
    if value.dtype.kind != "f":
        raise TypeError(f"{name}: masks some of its {value.dtype} values, which cannot be NaN; give {hint}")
    return value.filled(np.nan)


def pose(name: str, value: Any, *, farthest: float = MAX_POSE_M) -> np.ndarray:
    """Check that a pose that a user passes is a rigid motion. All functions that take poses use this check.

    Args:
        name: Name of the argument, for the message.
        value: `(4, 4)` matrix, such as a nested list.
        farthest: Largest plausible translation (m) along an axis.

    Returns:
        `(4, 4)` float64 matrix.

    Raises:
        TypeError: The argument holds anything but real numbers.
        ValueError: The matrix has another shape, is not finite, not rigid or transposed, or its translation is too
            large to be in metres.
    """
    T = numbers(name, value, "a (4, 4) transform").astype(np.float64)
    if T.shape != (4, 4):
        raise ValueError(f"{name}: has the shape {T.shape}; give a (4, 4) transform")
    if not np.isfinite(T).all():
        raise ValueError(
            f"{name}: is not a rigid motion (it is not finite: it holds NaN or infinity); measure it again, or leave "
            "it out"
        )
    if not _is_last_row(T[3]):
        hint = "perhaps it is transposed, with its translation there: give T.T" if _is_last_row(T[:, 3]) else ""
        row = ", ".join(f"{entry:g}" for entry in T[3])
        raise ValueError(f"{name}: is not a rigid motion (its last row is {row}); {hint or 'write 0, 0, 0, 1'}")
    if np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max() > ORTHOGONALITY_TOLERANCE:
        raise ValueError(
            f"{name}: is not a rigid motion (its rotation is scaled, bent or singular: its columns are not "
            "orthonormal); correct it, and give six digits or more"
        )
    if np.linalg.det(T[:3, :3]) < 0:
        raise ValueError(
            f"{name}: is not a rigid motion (it is mirrored: an axis has the wrong sign); make z the cross product of "
            "x and y"
        )
    if (distance := np.abs(T[:3, 3]).max()) > farthest:
        raise ValueError(
            f"{name}: lies {distance:g} m away, of at most {farthest:g}; give metres: divide millimetres by 1000"
        )
    return T


def _is_last_row(row: np.ndarray) -> bool:
    return bool(np.abs(row - [0, 0, 0, 1]).max() <= LAST_ROW_TOLERANCE)


def number(
    name: str, value: Any, hint: str, *, minimum: int | float = -math.inf, above: int | float = -math.inf
) -> None:
    """Refuse anything but a single finite number within a range. A traced number is accepted.

    Args:
        name: Name of the argument, for the message.
        value: The argument.
        hint: What to give instead, for the message.
        minimum: Smallest number that is allowed.
        above: Number that the argument must exceed.

    Raises:
        TypeError: The argument is not a real number.
        ValueError: The argument is an array, not finite, or out of range.
    """
    if is_traced(value):
        return
    array = numbers(name, value, hint)
    if array.ndim != 0:
        raise ValueError(f"{name}: has the shape {array.shape}, but must be one number; give {hint}")
    if not (math.isfinite(array) and array >= minimum and array > above):
        raise ValueError(f"{name}: is {array:g}; give {hint}")


def forces(name: str, value: Any, *, measured: bool = False) -> np.ndarray:
    """Check forces (N) along tool z that press a skin.

    Args:
        name: Name of the argument, for the message.
        value: A number or an array of numbers.
        measured: Whether the forces were measured, so that noise may make them zero or negative.

    Returns:
        Array of the forces (N) with their signs as given.

    Raises:
        TypeError: The argument holds anything but real numbers.
        ValueError: A force is not finite, is larger than a skin bears, or, if not measured, does not press.
    """
    array = numbers(name, value, "newtons along tool z")
    if not np.isfinite(array).all():
        wrong = array[~np.isfinite(array)].ravel()[0]
        raise ValueError(f"{name} is {wrong:g}, which is not finite; give newtons, or leave this touch out")
    if not measured and array.size and array.min() <= 0:
        raise ValueError(f"{name} is {array.min():g} N; a skin is pressed, not pulled; give a pressing force")
    largest = np.abs(array).max(initial=0.0)
    if largest > MAX_SKIN_FORCE_N:
        raise ValueError(f"{name} is {largest:g} N; a skin bears at most {MAX_SKIN_FORCE_N:g} N; give newtons")
    return array


def count(name: str, value: Any, *, minimum: int = 1) -> int:
    """Check that a user's argument is a whole number that is not too small.

    Args:
        name: Name of the argument, for the message.
        value: The argument.
        minimum: Smallest number that is allowed.

    Returns:
        The number as an int.

    Raises:
        TypeError: The argument is not a whole number.
        ValueError: The number is smaller than `minimum`.
    """
    try:
        whole = operator.index(value)
    except TypeError:
        whole = None
    if whole is None or isinstance(value, bool | np.bool_):
        raise TypeError(f"{name}: is {_short(value)}, not a whole number; give one from {minimum}")
    if whole < minimum:
        raise ValueError(f"{name}: is {whole}; give a whole number from {minimum}")
    return whole


def random_key(name: str, value: Any) -> None:
    """Refuse anything but a random key of JAX.

    Args:
        name: Name of the argument, for the message.
        value: The argument.

    Raises:
        TypeError: The argument is something else, such as a seed.
    """
    kind = str(getattr(value, "dtype", ""))
    new, old = kind.startswith("key<"), kind == "uint32" and getattr(value, "shape", ())[-1:] == (2,)
    if not (new or old):
        raise TypeError(f"{name}: is {_short(value)}, not a random key; give jax.random.key(0)")


def round_tip(text: str, largest_mm: float = 100.0) -> tuple[str, float]:
    """Parse the shape and radius of a round indenter from a text such as `sphere:4`.

    Args:
        text: `sphere:RADIUS` or `cylinder:RADIUS` with the radius in mm; case does not matter.
        largest_mm: Largest plausible radius in mm; one of the default radius is flat to 0.5 mm on a skin of 20 mm.

    Returns:
        The shape, "sphere" or "cylinder", and the radius in mm.

    Raises:
        ValueError: The text does not describe a round indenter. The message completes a sentence about the text.
    """
    kind, _, size = (part.strip() for part in text.partition(":"))
    shape = kind.lower()
    if shape not in ROUND_TIPS:
        raise ValueError(f"its shape {kind!r} is unknown; {did_you_mean(shape, ROUND_TIPS, '')}".removesuffix("; "))
    if not size:
        raise ValueError(f"its radius is missing; give it in mm, such as {shape}:4")
    try:
        radius = float(size)
    except ValueError:
        number = re.match(r"\d+(?:[.,]\d+)?", size)
        example = f"{shape}:{number[0].replace(',', '.') if number else 4}"
        raise ValueError(
            f"its radius {size!r} is not a number; give it in mm without a unit, such as {example}"
        ) from None
    if not radius > 0:
        raise ValueError(f"its radius is {size}, and must be positive, in mm")
    if radius < MIN_TIP_RADIUS_MM:
        raise ValueError(f"its radius of {size} mm is smaller than {MIN_TIP_RADIUS_MM:g} mm; give it in mm, not in m")
    if not radius <= largest_mm:
        raise ValueError(f"its radius of {size} mm is larger than {largest_mm:g} mm; give it in mm")
    return shape, radius


def _short(value: Any) -> str:
    """Describe a value in a few words for a message."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 40 else f"a {type(value).__name__}"
