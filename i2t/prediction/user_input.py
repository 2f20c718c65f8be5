"""Checks of the data that a user gives to a predictor.

A model answers whatever numbers it is given: a patch in millimetres, a pose inside the object, a million newtons. Each
is refused here in one sentence, or warned of where it may be meant. Pixels that nobody saw are filled in two ways, as
if nothing were there and as if the surface went on, so that a prediction can say by how much they matter.
"""

import math
import warnings
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from i2t import validation
from i2t.depth.patches import DepthPatch, DepthView
from i2t.objects.mesh_files import MAX_SIZE_M
from i2t.patches.dimensions import STANDOFF
from i2t.patches.views import WideView, centre, pixels_on_skin
from i2t.types import Patch, Surface

UNUSUAL_FORCE_RATIO = 10.0  # to the median of the training touches, where their largest force is not known
MAX_FORCE_RATIO = 4.0  # to the largest force of the training touches: beyond it a prediction says nothing
MAX_TRAVEL_M = 20e-3  # m past first contact; a skin is 2 to 20 mm thick
MAX_GAP_M = 10e-3  # m between the skin and the surface at a pose where they are said to touch
MAX_CLOSE_GAP_M = 1e-3  # m likewise, by which a pose may be off without a word: how far cameras and arms err
MAX_LEAST_PIXEL_M = 1e-3  # m, nearest pixel of a patch, whose values count from that pixel
MAX_CENTRE_STEP_M = 0.5e-3  # m, by which nine in ten pixels of a patch may differ from the middle of its wide view
LEAST_SEEN_SHARE = 0.5  # of a patch's pixels; with fewer there is a warning
MIN_SEEN_SHARE = 0.1  # likewise; with fewer there is no prediction
POSE_REMEDY = "move T_o_t onto it (i2t.contact_pose)"
VIEW_REMEDY = (
    "move the tool onto it (i2t.pose_at_pixel), or correct the unit of the depth image: give metres, by its camera's "
    "scale, such as 1e-4 where it stores tenths of a millimetre"
)
BESIDE_CENTRE = np.array([0.537, 0.471])  # pixels; a ray through a pixel's centre meets edges of symmetric meshes
PATCH_SIZE_TOLERANCE = 1e-3  # relative: rounding
PIXEL_TOLERANCE_M = 1e-6  # m, of single precision


class SeenTouches(NamedTuple):
    """A depth patch or many, with what came with it; None where nothing did."""

    depth: Any  # (p, p) or (n, p, p) m behind the nearest point
    nearest: Any = None  # one or (n,) m, signed distance of that point; NaN where it is unknown
    wide: Any = None  # (w, w) or (n, w, w) m, the surroundings too
    valid: Any = None  # (p, p) or (n, p, p) bool, pixels that were seen
    window: Any = None  # m, edge of the patches; one or (n,), NaN where it is unknown
    reach: Any = None  # m, at which they are clipped; likewise


def seen_touches(patch: Any, *, nearest: Any = None, wide: Any = None, valid: Any = None) -> SeenTouches:
    """The parts of whatever holds depth patches.

    Args:
        patch: Depths, a `Patch`, a `WideView`, a `DepthPatch`, a `DepthView`, a `TouchBatch`, what a collection saw
            (`i2t.collect.touch.SeenPatch`), or a list of them.
        nearest: What a user gave in place of what came with the patch; None where nothing was given.
        wide: The same.
        valid: The same.

    Returns:
        Depths, and what came with them.

    Raises:
        ValueError: A list holds different kinds.
    """
    if isinstance(patch, list | tuple) and patch and all(hasattr(item, "_fields") for item in patch):
        if len({type(item) for item in patch}) > 1:
            raise ValueError("patch: is a list of different kinds of patches; give them in lists of one kind")
        items, patch = patch, jax.tree.map(lambda *items: np.stack(items), *patch)
        if isinstance(patch, DepthPatch):
            sizes = np.array([(item.window, item.reach) for item in items], float)  # NaN where it is unknown
            patch.window, patch.reach = sizes.T
    seen = _parts(patch)
    given = {"nearest": nearest, "wide": wide, "valid": valid}
    return seen._replace(**{name: value for name, value in given.items() if value is not None})


def _parts(patch: Any) -> SeenTouches:
    """Depths, and what came with them."""
    if isinstance(patch, Patch):
        return SeenTouches(patch.depth, patch.nearest)
    if isinstance(patch, DepthPatch):
        return SeenTouches(*patch.patch, valid=np.asarray(patch.valid_mask), window=patch.window, reach=patch.reach)
    if isinstance(patch, DepthView):
        depth, nearest = patch.view.patch
        return SeenTouches(depth, nearest, patch.view.wide, centre(np.asarray(patch.known_mask), depth.shape[-1]))
    if isinstance(patch, WideView):
        return SeenTouches(*patch.patch, wide=patch.wide)
    # By their fields: the modules of these two import this one.
    names = set(getattr(patch, "_fields", ()))
    if {"patch", "nearest", "view", "pitch"} <= names:  # a `TouchBatch`
        return SeenTouches(patch.patch, patch.nearest, patch.view)
    if {"patch", "nearest", "wide", "visible_share"} <= names:  # a `SeenPatch`
        return SeenTouches(patch.patch, patch.nearest, patch.wide)
    return SeenTouches(patch)


def check_size_of_patches(seen: SeenTouches, window: float, reach: float) -> None:
    """Refuse patches that say that they show another square or depth than the model was trained on.

    Args:
        seen: The patches.
        window: m, edge of the model's patches.
        reach: m, at which they are clipped.

    Raises:
        ValueError: They are of another size.
    """
    for name, given, own in (("window", seen.window, window), ("reach", seen.reach, reach)):
        sizes = np.atleast_1d(np.array(given, np.float64))
        wrong = sizes[np.abs(sizes - own) > PATCH_SIZE_TOLERANCE * own]
        if len(wrong):
            raise ValueError(
                f"patch: its {name} is {_mm(float(wrong[0]))} mm, and the model was trained on patches of {_mm(own)} "
                f"mm; make it with {name}={own:g}"
            )


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


def checked_column(
    name: str, values: Any, n: int, default: float | None, *, unknown: bool = False
) -> Float[np.ndarray, " n"]:
    """A value for each of n touches.

    Args:
        name: Of the value, for the message.
        values: One for all, or one for each; None where it was left out.
        n: Number of touches.
        default: Taken where it was left out; None where there is none.
        unknown: Whether a value may be NaN, where it is not known of a touch.

    Returns:
        The values; NaN where there is neither a value nor a default.

    Raises:
        ValueError: They are not finite, or not as many.
    """
    if values is None:
        return np.full(n, np.nan if default is None else default, np.float32)
    numbers = validation.numbers(name, values, "one number for all touches or one for each").astype(np.float32)
    column = np.full(n, numbers) if numbers.ndim == 0 else numbers
    if column.shape != (n,):
        raise ValueError(f"{name} has the shape {numbers.shape}; give one for all touches or one for each of {n}")
    if not (np.isfinite(column) | (unknown & np.isnan(column))).all():
        raise ValueError(f"{name} is not finite{_which(~np.isfinite(column))}; give numbers, or leave it out")
    return column


def check_press(
    force: Float[np.ndarray, " n"],
    depth: Float[np.ndarray, " n"],
    *,
    usual_force: float,
    largest_force: float | None = None,
) -> None:
    """Refuse presses that no skin makes or of which a model knows nothing, and warn of those beyond its training.

    Args:
        force: N, along tool z, positive where it presses.
        depth: m, past first contact; NaN where it is unknown.
        usual_force: N, the median of the training touches.
        largest_force: N, of the training touches; None where it is not known.

    Raises:
        ValueError: A force pulls, presses nothing, breaks a skin or is far beyond the training touches, or a length is
            none in metres.
    """
    validation.forces("force", force)
    trained = largest_force or UNUSUAL_FORCE_RATIO * usual_force
    about = f"presses of at most {trained:.2g} N" if largest_force else f"presses of about {usual_force:.2g} N"
    hardest = float(force.max())
    if trained and hardest > MAX_FORCE_RATIO * trained:
        raise ValueError(
            f"force is {hardest:g} N, and the model was trained on {about}: it knows nothing of so hard a press; "
            f"give at most {MAX_FORCE_RATIO * trained:.2g} N, or train on harder presses"
        )
    if trained and hardest > trained:
        warnings.warn(
            f"force is {hardest:g} N, and the model was trained on {about}: what it says of so hard a press is no more "
            "than a guess",
            stacklevel=3,
        )
    longest = np.max(np.abs(depth), initial=0.0, where=np.isfinite(depth))
    if longest > MAX_TRAVEL_M:
        raise ValueError(f"depth is {longest:g} m, more than {MAX_TRAVEL_M:g}; give metres")


def check_met(
    nearest: Float[np.ndarray, " n"],
    wide: Float[np.ndarray, "n w w"] | None,
    pitch: float,
    *,
    remedy: str,
    warn: bool = True,
    stacklevel: int = 3,
) -> None:
    """Refuse touches in which the skin does not lie on the surface, and warn of those that meet nothing, or meet
    something beside the patch first.

    Args:
        nearest: m, signed distance of the patch's nearest point from the tool origin; NaN where it is unknown.
        wide: m, views with their surroundings; None where there are only patches.
        pitch: m, edge of a pixel.
        remedy: What to do, for the message.
        warn: Whether to warn too.
        stacklevel: Of the warnings.

    Raises:
        ValueError: The surface begins more than 10 mm in front of the skin, or behind it.
    """
    stands_out = np.zeros(len(nearest))
    if wide is not None:
        on_skin = centre(np.asarray(wide), min(pixels_on_skin(pitch), wide.shape[-1]))
        stands_out = np.maximum(-np.nanmin(on_skin, axis=(1, 2)), 0.0)
    met = np.nan_to_num(nearest - stands_out)
    worst = int(met.argmax())
    if met[worst] > MAX_GAP_M:
        raise ValueError(
            f"the surface begins {_mm(float(met[worst]))} mm in front of the skin at this pose"
            f"{_which(met > MAX_GAP_M)}; {remedy}"
        )
    behind = nearest < -MAX_GAP_M
    if behind.any():
        raise ValueError(
            f"the surface begins {_mm(float(-np.nanmin(nearest)))} mm behind the skin at this pose"
            f"{_which(behind)}: the object is in the way, as in a cup, or tool z, which points into the object, points "
            f"away from it; {remedy}"
        )
    if warn and met[worst] > MAX_CLOSE_GAP_M:
        warnings.warn(
            f"the surface begins {1e3 * met[worst]:.3g} mm in front of the skin at this pose"
            f"{_which(met > MAX_CLOSE_GAP_M)}: a press that ends there meets nothing and reads zero; the prediction is "
            "for a skin that is moved on until it presses",
            stacklevel=stacklevel,
        )
    if warn and stands_out.max() > MAX_CLOSE_GAP_M:
        warnings.warn(
            f"the object stands out by {1e3 * stands_out.max():.3g} mm beside the patch and under the skin's rim at "
            "this pose: it is met first, and what is predicted is the reading of a press on it",
            stacklevel=stacklevel,
        )


def checked_valid(valid: Any, shape: tuple[int, ...]) -> Bool[np.ndarray, "n p p"]:
    """The mask of seen pixels that a user gave.

    Args:
        valid: (p, p) or (n, p, p) bool.
        shape: Of the patches, (p, p) or (n, p, p).

    Returns:
        The mask, touches on axis 0.

    Raises:
        ValueError: It does not fit the patches, or of a patch nearly nothing was seen.
    """
    mask, shape = np.asarray(valid), shape if len(shape) == 3 else (1, *shape)
    mask = np.broadcast_to(mask, shape) if mask.ndim == 2 and mask.shape == shape[1:] else mask
    if mask.dtype != np.bool_ or mask.shape != shape:
        raise ValueError(f"valid is {mask.dtype} {np.shape(valid)}; give booleans, one for each pixel of the patch")
    share = mask.mean((1, 2))
    if not share.all():
        raise ValueError(
            f"no pixel of the patch was seen{_which(share == 0)}: in a hole of the depth image, or outside it, or "
            f"the surface is more than {1e3 * STANDOFF:g} mm behind the skin; look again, or correct pose and unit"
        )
    if share.min() < MIN_SEEN_SHARE:
        raise ValueError(
            f"only {100 * share.min():.0f} % of the patch was seen{_which(share < MIN_SEEN_SHARE)}, too little to say "
            "what the skin meets; look again, from another side"
        )
    if share.min() < LEAST_SEEN_SHARE:
        warnings.warn(
            f"only {100 * share.min():.0f} % of the patch was seen; what lies on the rest is a guess", stacklevel=3
        )
    return mask


def fill_unseen(
    patches: Float[np.ndarray, "n p p"], valid: Bool[np.ndarray, "*n p p"], reach: float
) -> tuple[Float[np.ndarray, "n p p"], Float[np.ndarray, "n p p"]]:
    """Patches with unseen pixels empty, and patches with unseen pixels as the nearest seen one.

    Args:
        patches: m.
        valid: Pixels that were seen, some of each patch.
        reach: m, of a pixel without a surface.

    Returns:
        Both.
    """
    mask = np.broadcast_to(valid, patches.shape)
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
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise ValueError(f"T_o_t must be a (4, 4) transform, or (n, 4, 4) of them; got shape {np.shape(T_o_t)}")
    for number, pose in enumerate(poses):
        validation.pose("T_o_t" if len(poses) == 1 else f"T_o_t[{number}]", pose)
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
    pitch = window / len(view.patch.depth)
    check_met(np.array([nearest]), np.asarray(view.wide)[None], pitch, remedy=POSE_REMEDY, stacklevel=5)
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


def _mm(length: float) -> str:
    """Millimetres of a length (m) to three digits, without an exponent."""
    return f"{float(f'{1e3 * length:.3g}'):.10g}"


def _which(touches: Bool[np.ndarray, " n"]) -> str:
    """Touch that a message is about."""
    return "" if len(touches) == 1 else f" (touch {int(np.flatnonzero(touches)[0])})"
