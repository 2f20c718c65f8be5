"""Checks of a user's arguments to a public function: numbers, poses, counts and random keys.

Wrong types are a TypeError and wrong values a ValueError, in one sentence that names the argument. Values that `jit`,
`vmap` or a derivative traces are not known yet and pass.
"""

import math
import operator
import re
from typing import Any

import numpy as np

from i2t.errors import did_you_mean
from i2t.patches.dimensions import LAST_ROW_TOLERANCE, MAX_POSE_M, MAX_SKIN_FORCE_N, ORTHOGONALITY_TOLERANCE

ROUND_TIPS = ("sphere", "cylinder")
MIN_TIP_RADIUS_MM = 0.1  # of an indenter; smaller ones are meant in metres
MAX_TIP_RADIUS_MM = 100.0  # a ball of 20 cm; under a skin of 20 mm a larger one is flat to 0.5 mm
REAL_KINDS = "iuf"  # of NumPy: integers and floats; no booleans, text or objects


def is_traced(*values: Any) -> bool:
    """Test whether a value is traced by JAX, so that it has no number yet.

    Args:
        values: Any.

    Returns:
        Whether one of them is.
    """
    return any("Tracer" in type(value).__name__ for value in values)


def numbers(name: str, value: Any, hint: str) -> np.ndarray:
    """Real numbers that a user gave, in any shape.

    Args:
        name: Of the argument, for the message.
        value: A number, or an array or nested list of them.
        hint: What to give, for the message.

    Returns:
        The array; integers and floats stay as they are, and masked floats become NaN.

    Raises:
        TypeError: It holds something else than real numbers, rows of different lengths, or masked integers.
    """
    value = _without_mask(name, value, hint)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:  # rows of different lengths
        raise TypeError(f"{name}: is a {type(value).__name__} that makes no array; give {hint}") from error
    if array.dtype.kind not in REAL_KINDS and array.size:
        raise TypeError(f"{name}: is {_short(value)}, and no real numbers; give {hint}")
    return array


def _without_mask(name: str, value: Any, hint: str) -> Any:
    """A masked array with NaN where it is masked; everything else as it is."""
    if not isinstance(value, np.ma.MaskedArray) or not np.ma.getmaskarray(value).any():
        return value
    if value.dtype.kind != "f":
        raise TypeError(f"{name}: masks some of its {value.dtype}, which have no NaN to mark them; give {hint}")
    return value.filled(np.nan)


def pose(name: str, value: Any, *, farthest: float = MAX_POSE_M) -> np.ndarray:
    """A rigid motion that a user gave: the only check of poses, so that all of them answer alike.

    Args:
        name: Of the pose, for the message.
        value: (4, 4), such as a nested list.
        farthest: The largest translation (m) along an axis that makes sense.

    Returns:
        (4, 4) float64.

    Raises:
        TypeError: It holds something else than real numbers.
        ValueError: It has another shape, is not finite or not rigid, is transposed, or lies too far away for metres.
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


def number(name: str, value: Any, hint: str, *, least: int | float = -math.inf, above: int | float = -math.inf) -> None:
    """Refuse anything but a single finite number within its range; a traced one passes.

    Args:
        name: Of the argument, for the message.
        value: That was given.
        hint: What to give, for the message.
        least: The smallest that is allowed.
        above: What it must be larger than.

    Raises:
        TypeError: It is no real number.
        ValueError: It is an array, not finite, or out of its range.
    """
    if is_traced(value):
        return
    array = numbers(name, value, hint)
    if array.ndim != 0:
        raise ValueError(f"{name}: has the shape {array.shape}, and one number is meant; give {hint}")
    if not (math.isfinite(array) and array >= least and array > above):
        raise ValueError(f"{name}: is {array:g}; give {hint}")


def forces(name: str, value: Any, *, measured: bool = False) -> np.ndarray:
    """Check forces (N) along tool z that press a skin.

    Args:
        name: Name of the argument, for the message.
        value: A number or an array of numbers.
        measured: Whether the forces were measured, so that noise may make them zero or negative.

    Returns:
        The forces as an array, with their signs as given.

    Raises:
        TypeError: The value holds other things than real numbers.
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


def count(name: str, value: Any, *, least: int = 1) -> int:
    """A whole number of things.

    Args:
        name: Of the argument, for the message.
        value: That was given.
        least: The smallest that is allowed.

    Returns:
        The number.

    Raises:
        TypeError: It is no whole number.
        ValueError: It is smaller.
    """
    try:
        whole = operator.index(value)
    except TypeError:
        whole = None
    if whole is None or isinstance(value, bool | np.bool_):
        raise TypeError(f"{name}: is {_short(value)}, and no whole number; give one from {least}")
    if whole < least:
        raise ValueError(f"{name}: is {whole}; give a whole number from {least}")
    return whole


def random_key(name: str, value: Any) -> None:
    """Refuse anything but a random key of JAX.

    Args:
        name: Of the argument, for the message.
        value: That was given.

    Raises:
        TypeError: It is something else, such as the seed of a key.
    """
    kind = str(getattr(value, "dtype", ""))
    new, old = kind.startswith("key<"), kind == "uint32" and getattr(value, "shape", ())[-1:] == (2,)
    if not (new or old):
        raise TypeError(f"{name}: is {_short(value)}, and no random key; give jax.random.key(0)")


def round_tip(text: str, largest_mm: float = MAX_TIP_RADIUS_MM) -> tuple[str, float]:
    """Shape and radius of a round indenter from its name, such as `sphere:4`.

    Args:
        text: `sphere:RADIUS` or `cylinder:RADIUS`, the radius in mm; capitals do not matter.
        largest_mm: The largest radius that makes sense, mm.

    Returns:
        "sphere" or "cylinder", and the radius in mm.

    Raises:
        ValueError: The text does not name a round indenter. The message completes a sentence about the text.
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
    """A value in short form for a message."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 40 else f"a {type(value).__name__}"
