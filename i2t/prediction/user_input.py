"""Checks of the data that a user gives to a predictor.

A model answers whatever numbers it is given: a patch in millimetres, a pose inside the object, a million newtons. Each
is refused here in one sentence, or warned of where it may be meant. Pixels that nobody saw are filled in two ways, as
if nothing were there and as if the surface went on, so that a prediction can say by how much they matter.
"""

import math
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from i2t import validation
from i2t.geometry import is_rigid
from i2t.objects.mesh_files import MAX_SIZE_M
from i2t.types import Surface
from i2t.views import WideView, centre, pixels_on_skin
from i2t.windows import MAX_SKIN_FORCE_N, STANDOFF

UNUSUAL_FORCE_RATIO = 10.0  # to the median of the training touches: beyond it nothing is known
MAX_TRAVEL_M = 20e-3  # m past first contact; a skin is 2 to 20 mm thick
MAX_NEAREST_M = 0.1  # m, signed distance of a surface that a skin is about to meet
MAX_GAP_M = 10e-3  # m between the skin and the surface at a pose where they are said to touch
MAX_CLOSE_GAP_M = 1e-3  # m likewise, by which a pose may be off without a word: how far cameras and arms err
MAX_LEAST_PIXEL_M = 1e-3  # m, nearest pixel of a patch, whose values count from that pixel
MAX_CENTRE_STEP_M = 0.5e-3  # m, by which nine in ten pixels of a patch may differ from the middle of its wide view
LEAST_SEEN_SHARE = 0.5  # of a patch's pixels; with fewer there is a warning
BESIDE_CENTRE = np.array([0.537, 0.471])  # pixels; a ray through a pixel's centre meets edges of symmetric meshes
PIXEL_TOLERANCE_M = 1e-6  # m, of single precision
CLASSES = (64, 8, 1)  # touches that are predicted together, so that a new number of them compiles nothing


def size_classes(n: int) -> Iterator[np.ndarray]:
    """Share n touches out to batches of few sizes.

    Args:
        n: Number of touches, at least 1.

    Yields:
        Numbers of touches, as many as a class has: 0 to n - 1, of which the last batch repeats the last.
    """
    start = 0
    while start < n:
        left = n - start
        size = next(size for size in CLASSES if size <= left)
        if size == 1 and left > 1:
            size = CLASSES[-2]
        yield np.minimum(np.arange(start, start + size), n - 1)
        start += size


def checked_patches(patch: Any, reach: float) -> Float[np.ndarray, "n p p"]:
    """The depth patches that a user gave.

    Args:
        patch: (p, p) or (n, p, p) m behind the nearest point.
        reach: m, at which patches are clipped.

    Returns:
        The patches, touches on axis 0.

    Raises:
        ValueError: Shape or values are no depth patch's.
    """
    patches = _many("patch", patch, "metres behind the nearest point")
    if patches.ndim != 3 or patches.shape[1] != patches.shape[2] or not patches.size:
        raise ValueError(f"patch has shape {np.shape(patch)}; give (n, n) or (touches, n, n)")
    if not np.isfinite(patches).all():
        raise ValueError(
            "patch holds NaN or infinity; pixels without a surface are `reach`, and valid= says which were not seen"
        )
    least, most = patches.min((1, 2)), patches.max((1, 2))
    if least.min() < -PIXEL_TOLERANCE_M:
        raise ValueError(
            f"patch has negative pixels, down to {least.min():.3g}; it is metres behind the nearest point, so heights "
            "h above a plane are h.max() - h"
        )
    if most.max() > reach + max(PIXEL_TOLERANCE_M, 1e-3 * reach):
        in_mm = most.max() <= 1e3 * reach * 1.001
        raise ValueError(
            f"patch has pixels of {most.max():.3g}, and it is metres behind the nearest point, at most {reach:g}; "
            + ("divide millimetres by 1000" if in_mm else "clip it there")
        )
    empty = least >= reach - PIXEL_TOLERANCE_M
    if empty.any():
        raise ValueError(
            f"patch shows no surface{_which(empty)}: all pixels are at the reach; nothing would be felt there"
        )
    if least.max() > MAX_LEAST_PIXEL_M:
        raise ValueError(
            f"patch begins {1e3 * least.max():.3g} mm behind its nearest point{_which(least > MAX_LEAST_PIXEL_M)}; it "
            "counts from that point: subtract patch.min(), or turn heights over: h.max() - h"
        )
    return patches


def checked_wide(wide: Any, patches: Float[np.ndarray, "n p p"], reach: float) -> Float[np.ndarray, "n w w"]:
    """The views with their surroundings that a user gave with patches.

    Args:
        wide: (w, w) or (n, w, w) m, pixels of the patches' size; negative where something stands out before the
            patch's nearest point, NaN where nothing is known at the rim.
        patches: The patches, each the middle of its view.
        reach: m, at which they are clipped.

    Returns:
        The views.

    Raises:
        ValueError: Shape or values do not fit the patches.
    """
    n, pixels = patches.shape[:2]
    views = _many("wide", wide, "metres behind the patch's nearest point")
    if views.ndim != 3 or len(views) != n or views.shape[1] != views.shape[2] or views.shape[1] < pixels:
        raise ValueError(
            f"wide has shape {np.shape(wide)}; give ({n}, w, w) with w at least the {pixels} pixels of a patch"
        )
    middle = centre(views, pixels)
    if not np.isfinite(middle).all():
        raise ValueError("wide is NaN or infinite where the patch is; give what the camera saw there, or leave it out")
    if np.nanmax(views) > reach + max(PIXEL_TOLERANCE_M, 1e-3 * reach) or np.isinf(views).any():
        raise ValueError(
            f"wide has pixels of {np.nanmax(views):.3g}, and it is metres behind the patch's nearest point, at most "
            f"{reach:g}; clip it there, or divide millimetres by 1000"
        )
    other = np.quantile(np.abs(np.clip(middle, 0, reach) - patches), 0.9, axis=(1, 2)) > MAX_CENTRE_STEP_M
    if other.any():
        raise ValueError(
            f"wide is another view than the patch{_which(other)}, or has pixels of another size; its middle must be "
            "the patch"
        )
    return views


def checked_column(name: str, values: Any, n: int, default: float | None) -> Float[np.ndarray, " n"]:
    """A value for each of n touches.

    Args:
        name: Of the value, for the message.
        values: One for all, or one for each; None where it was left out.
        n: Number of touches.
        default: Taken where it was left out; None where there is none.

    Returns:
        The values; NaN where there is neither a value nor a default.

    Raises:
        ValueError: They are not finite, or not as many.
    """
    if values is None:
        return np.full(n, np.nan if default is None else default, np.float32)
    numbers = validation.numbers(name, values, "one number for all touches or one for each").astype(np.float32)
    column = np.full(n, numbers) if numbers.ndim == 0 else numbers
    if column.shape != (n,) or not np.isfinite(column).all():
        raise ValueError(
            f"{name} has the shape {numbers.shape} or is not finite; give one for all touches or one for each of {n}"
        )
    return column


def check_press(
    force: Float[np.ndarray, " n"],
    nearest: Float[np.ndarray, " n"],
    depth: Float[np.ndarray, " n"],
    *,
    usual_force: float,
) -> None:
    """Refuse presses that no skin makes, and warn of those beyond what a model was trained on.

    Args:
        force: N, along tool z.
        nearest: m, signed distance of the nearest point; NaN where it was left out.
        depth: m, past first contact.
        usual_force: N, the median of the training touches; negative where the recording counts a pressing force so.

    Raises:
        ValueError: A force pulls or breaks a skin, or a length is none in metres.
    """
    pressing = -force if usual_force < 0 else force
    if pressing.min() < 0:
        sign = ", which this model's recording counts negative" if usual_force < 0 else ""
        raise ValueError(f"force is {force[pressing.argmin()]:g} N; a skin is pressed{sign}, not pulled")
    if pressing.max() > MAX_SKIN_FORCE_N:
        raise ValueError(f"force is {pressing.max():g} N; a skin bears at most {MAX_SKIN_FORCE_N:g} N")
    if usual_force and pressing.max() > UNUSUAL_FORCE_RATIO * abs(usual_force):
        warnings.warn(
            f"force is {pressing.max():g} N, and the model was trained at about {abs(usual_force):.2g} N: what it says "
            "of so hard a press is no more than a guess",
            stacklevel=3,
        )
    for name, values, most in (("nearest", nearest, MAX_NEAREST_M), ("depth", depth, MAX_TRAVEL_M)):
        largest = np.max(np.abs(values), initial=0.0, where=np.isfinite(values))
        if largest > most:
            raise ValueError(f"{name} is {largest:g} m, more than {most:g}; give metres")


def fill_unseen(
    patches: Float[np.ndarray, "n p p"], valid: Any, reach: float
) -> tuple[Float[np.ndarray, "n p p"], Float[np.ndarray, "n p p"]]:
    """Patches with unseen pixels empty, and patches with unseen pixels as the nearest seen one.

    Args:
        patches: m.
        valid: (p, p) or (n, p, p) bool, pixels that were seen.
        reach: m, of a pixel without a surface.

    Returns:
        Both.

    Raises:
        ValueError: The mask does not fit the patches, or nothing was seen.
    """
    mask = np.asarray(valid)
    mask = np.broadcast_to(mask, patches.shape) if mask.ndim == 2 and mask.shape == patches.shape[1:] else mask
    if mask.dtype != np.bool_ or mask.shape != patches.shape:
        raise ValueError(f"valid is {mask.dtype} {np.shape(valid)}; give booleans, one for each pixel of the patch")
    share = mask.mean((1, 2))
    if not share.all():
        raise ValueError(f"valid says that no pixel of the patch was seen{_which(share == 0)}; look again")
    if share.min() < LEAST_SEEN_SHARE:
        warnings.warn(
            f"only {100 * share.min():.0f} % of the patch was seen; what lies on the rest is a guess", stacklevel=3
        )
    nearest = [ndimage.distance_transform_edt(~one, return_distances=False, return_indices=True) for one in mask]
    continued = np.stack([patch[tuple(index)] for patch, index in zip(patches, nearest, strict=True)])
    return np.where(mask, patches, np.float32(reach)), continued


def in_middle(views: Float[np.ndarray, "n w w"], patches: Float[np.ndarray, "n p p"]) -> Float[np.ndarray, "n w w"]:
    """Views with patches in their middles.

    Args:
        views: m.
        patches: m, with pixels of the same size.

    Returns:
        The views.
    """
    changed = views.copy()
    centre(changed, patches.shape[1])[:] = patches
    return changed


def checked_poses(T_o_t: Any) -> Float[np.ndarray, "n 4 4"]:
    """The tool poses that a user gave.

    Args:
        T_o_t: (4, 4) or (n, 4, 4).

    Returns:
        The poses, on axis 0.

    Raises:
        ValueError: They are no rigid transforms.
    """
    poses = _many("T_o_t", T_o_t, "a (4, 4) transform, or (n, 4, 4)")
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses) or not np.isfinite(poses).all():
        raise ValueError(f"T_o_t must be a finite (4, 4) transform, or (n, 4, 4) of them; got shape {np.shape(T_o_t)}")
    if not all(bool(is_rigid(pose)) for pose in poses):
        raise ValueError("T_o_t is no rigid transform: its rotation is scaled, mirrored or bent; make it orthonormal")
    return poses


def check_size(mesh: Any) -> None:
    """Refuse a mesh that is too large to be in metres.

    Args:
        mesh: Anything with vertices.

    Raises:
        ValueError: It is larger than what a tool touches.
    """
    vertices = np.asarray(getattr(mesh, "vertices", np.zeros((1, 3))), np.float64).reshape(-1, 3)
    size = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
    if size > MAX_SIZE_M:
        raise ValueError(
            f"mesh is {size:.3g} m across; its vertices are taken for metres: i2t.load_mesh(file, 'mm') converts a "
            "file, and scaling by 1e-3 a mesh"
        )


def check_in_front(surface: Surface, T_o_t: Float[np.ndarray, "4 4"], view: WideView, window: float) -> None:
    """Refuse a pose at which the skin does not lie on the surface, and warn of one where something else is met first.

    Args:
        surface: That is touched, in W.
        T_o_t: Pose of the tool.
        view: What lies in front of it.
        window: m, edge of the patch.

    Raises:
        ValueError: Nothing is in front of the skin, it is away from the surface or inside the object, or its z points
            away from it.
    """
    nearest = float(view.patch.nearest)
    if not math.isfinite(nearest):
        raise ValueError("nothing lies in front of the skin's middle at this pose; move T_o_t towards the surface")
    on_skin = min(pixels_on_skin(window / len(view.patch.depth)), len(view.wide))
    stands_out = max(-float(np.min(centre(np.asarray(view.wide), on_skin))), 0.0)
    met = nearest - stands_out
    if met > MAX_GAP_M:
        raise ValueError(
            f"the surface begins {1e3 * met:.3g} mm in front of the skin at this pose; move T_o_t onto it "
            "(i2t.contact_pose)"
        )
    if met > MAX_CLOSE_GAP_M:
        warnings.warn(
            f"the surface begins {1e3 * met:.3g} mm in front of the skin at this pose: a press that ends there "
            "meets nothing and reads zero; the prediction is for a skin that is moved on until it presses",
            stacklevel=4,
        )
    if stands_out > MAX_CLOSE_GAP_M:
        warnings.warn(
            f"the object stands out by {1e3 * stands_out:.3g} mm beside the patch and under the skin's rim at "
            "this pose: it is met first, and what is predicted is the reading of a press on it",
            stacklevel=4,
        )
    if nearest < -MAX_GAP_M:
        raise ValueError(
            f"the surface begins {-1e3 * nearest:.3g} mm behind the skin at this pose: the object is in the way, as in "
            "a cup, or tool z, which points into the object, points away from it (i2t.contact_pose)"
        )
    depth = np.asarray(view.patch.depth)
    row, column = np.unravel_index(int(depth.argmin()), depth.shape)
    x, y = ((np.array([column, row]) + BESIDE_CENTRE) / len(depth) - 0.5) * window
    if _starts_inside(np.asarray(surface.triangles, np.float64), T_o_t, float(x), float(y)):
        raise ValueError(
            "the skin would meet the surface from inside the object at this pose: it lies in the object, or tool z "
            "points out of it; make T_o_t by i2t.contact_pose"
        )


def _starts_inside(triangles: np.ndarray, T_o_t: np.ndarray, x: float, y: float) -> bool:
    """Test whether a ray along tool z starts inside a surface that is closed and faces outward along the whole line;
    false for other surfaces, where it is unknown.
    """
    rotation, origin = T_o_t[:3, :3].astype(np.float64), T_o_t[:3, 3].astype(np.float64)
    a, b, c = np.moveaxis((triangles - origin) @ rotation - np.array([x, y, 0.0]), 1, 0)

    def twice_area(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]

    parts = np.stack([twice_area(b, c), twice_area(c, a), twice_area(a, b)])
    whole = parts.sum(0)
    crossed = ((parts > 0).all(0) | (parts < 0).all(0)) & (whole != 0)
    height = (parts * np.stack([a, b, c])[:, :, 2]).sum(0)[crossed] / whole[crossed]
    leaves = (whole[crossed] > 0)[np.argsort(height)]  # whether the line leaves the object through the face
    height = np.sort(height)
    alternate = len(leaves) % 2 == 0 and not leaves[::2].any() and leaves[1::2].all()
    ahead = leaves[height > -STANDOFF]
    return bool(alternate and len(ahead) and ahead[0])


def _many(name: str, values: Any, hint: str) -> np.ndarray:
    """Images or transforms of one touch or of many, touches on axis 0."""
    array = validation.numbers(name, values, hint).astype(np.float32)
    return array[None] if array.ndim == 2 else array


def _which(touches: Bool[np.ndarray, " n"]) -> str:
    """Touch that a message is about."""
    return "" if len(touches) == 1 else f" (touch {int(np.flatnonzero(touches)[0])})"
