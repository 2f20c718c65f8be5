"""Checks of the data that a user gives to a predictor.

A model answers any numbers: a patch in millimetres, a pose inside the object, a million newtons. This module refuses
such input with one sentence, or warns if it may be intended. Unseen pixels are filled in two ways, as if they were
empty and as if the surface continued, so that a prediction can show how much they matter.
"""

import math
import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from i2t import validation
from i2t.depth.patches import DepthPatch, DepthView
from i2t.objects.mesh_files import MAX_SIZE_M
from i2t.patches.dimensions import PAD_WINDOW, STANDOFF
from i2t.patches.views import PatchView, centre, pixels_on_skin
from i2t.types import Patch, Surface


@dataclass(frozen=True)
class InputLimits:
    """Limits beyond which a user's input is refused or warned of: force ratios, lengths (m), share of seen pixels."""

    unknown_force_ratio: float = 10.0  # largest training force over the median one, if only the median is known
    # largest ratio of a force to the largest training force; beyond it a prediction means nothing
    max_force_ratio: float = 4.0
    max_travel: float = 20e-3  # m past first contact; a skin is 2 to 20 mm thick
    max_gap: float = 10e-3  # m between the skin and the surface at a pose of contact
    unnoticed_gap: float = 1e-3  # m, gap without a warning: the errors of cameras and arms
    max_nearest_pixel: float = 1e-3  # m, nearest pixel of a patch, whose depths count from that pixel
    max_centre_error: float = 0.5e-3  # m between nine in ten pixels of a patch and the middle of its view
    warned_seen_fraction: float = 0.5  # of a patch's pixels; below it there is a warning
    # largest predicted value over the largest one of the training touches; a larger one is warned of
    max_reading_ratio: float = 3.0
    # Margin around the range of the training touches, as a share of its width; below the range, as a share of its
    # least value if that is smaller. Of a few dozen touches, those held out are often a little outside the range of
    # the others.
    range_margin: float = 0.5
    mean_depth_margin: float = 0.125  # of the reach, the least margin of mean depths, whose range may be narrow
    min_seen_fraction: float = 0.1  # of a patch's pixels; below it there is no prediction
    size_tolerance: float = 1e-3  # relative rounding error of a patch's size
    pixel_tolerance: float = 1e-6  # m, rounding error of single precision


_INPUT_LIMITS = InputLimits()  # limits beyond which a user's input to a predictor is refused or causes a warning


class SeenTouches(NamedTuple):
    """Depth patches (m) of one or many touches, with nearest distance, view, seen pixels and size if they are given."""

    depth: Any  # (p, p) or (n, p, p) m behind the nearest point
    nearest: Any = None  # scalar or (n,) m, signed distance of that point; NaN where it is unknown
    view: Any = None  # (w, w) or (n, w, w) m, the patch with its surroundings
    valid: Any = None  # (p, p) or (n, p, p) bool, pixels that were seen
    window: Any = None  # scalar or (n,) m, edge of the patches; NaN where it is unknown
    reach: Any = None  # scalar or (n,) m, depth at which they are clipped; NaN where it is unknown


def seen_touches(patch: Any, *, nearest: Any = None, view: Any = None, valid: Any = None) -> SeenTouches:
    """Extract the depths and their accompanying data from any object that holds depth patches.

    Args:
        patch: Depths, a `Patch`, a `PatchView`, a `DepthPatch`, a `DepthView`, a `TouchBatch`, the view of a collection
            (`i2t.collect.touch.SeenPatch`), or a list of them.
        nearest: Signed distance (m) of the nearest point from the tool origin; None takes the patch's own.
        view: Depths (m) of the patch with its surroundings; None takes the patch's own.
        valid: Mask of the pixels that were seen; None takes the patch's own.

    Returns:
        Depths with their accompanying data.

    Raises:
        ValueError: A list holds different kinds of patches.
    """
    if isinstance(patch, list | tuple) and patch and all(hasattr(item, "_fields") for item in patch):
        if len({type(item) for item in patch}) > 1:
            raise ValueError("patch: is a list of different kinds of patches; give them in lists of one kind")
        items, patch = patch, jax.tree.map(lambda *items: np.stack(items), *patch)
        if isinstance(patch, DepthPatch):
            sizes = np.array([(item.window, item.reach) for item in items], float)  # NaN where it is unknown
            patch.window, patch.reach = sizes.T
    seen = _parts(patch)
    given = {"nearest": nearest, "view": view, "valid": valid}
    return seen._replace(**{name: value for name, value in given.items() if value is not None})


def _parts(patch: Any) -> SeenTouches:
    """Take the depths and their accompanying data from one object."""
    if isinstance(patch, Patch):
        return SeenTouches(patch.depth, patch.nearest)
    if isinstance(patch, DepthPatch):
        return SeenTouches(*patch.patch, valid=np.asarray(patch.valid_mask), window=patch.window, reach=patch.reach)
    if isinstance(patch, DepthView):
        depth, nearest = patch.view.patch
        return SeenTouches(depth, nearest, patch.view.depth, centre(np.asarray(patch.known_mask), depth.shape[-1]))
    if isinstance(patch, PatchView):
        return SeenTouches(*patch.patch, view=patch.depth)
    # These two are recognised by their fields, because their modules import this one.
    names = set(getattr(patch, "_fields", ()))
    if {"patch", "nearest", "view", "pitch"} <= names:  # a `TouchBatch`
        return SeenTouches(patch.patch, patch.nearest, patch.view)
    if {"patch", "nearest", "view", "visible_share"} <= names:  # a `SeenPatch`
        return SeenTouches(patch.patch, patch.nearest, patch.view)
    return SeenTouches(patch)


def check_size_of_patches(seen: SeenTouches, window: float, reach: float) -> None:
    """Refuse patches of another window or reach than those on which the model was trained.

    Args:
        seen: The patches.
        window: Edge (m) of the model's patches.
        reach: Depth (m) at which the model's patches are clipped.

    Raises:
        ValueError: A patch has another window or reach.
    """
    for name, given, own in (("window", seen.window, window), ("reach", seen.reach, reach)):
        sizes = np.atleast_1d(np.array(given, np.float64))
        wrong = sizes[np.abs(sizes - own) > _INPUT_LIMITS.size_tolerance * own]
        if len(wrong):
            raise ValueError(
                f"patch: its {name} is {_mm(float(wrong[0]))} mm, and the model was trained on patches of {_mm(own)} "
                f"mm; make it with {name}={own:g}"
            )


def checked_patches(patch: Any, reach: float) -> Float[np.ndarray, "n p p"]:
    """Check the depth patches of a user.

    Args:
        patch: Depths (p, p) or (n, p, p), in m behind the nearest point, for p pixels along an edge.
        reach: Depth (m) at which patches are clipped.

    Returns:
        `(n, p, p)` patches (m).

    Raises:
        ValueError: Shape or values are not those of a depth patch.
    """
    patches = _many("patch", patch, "metres behind the nearest point")
    if patches.ndim != 3 or patches.shape[1] != patches.shape[2] or not patches.size:
        raise ValueError(f"patch has shape {np.shape(patch)}; give (n, n) or (touches, n, n)")
    if not np.isfinite(patches).all():
        raise ValueError(
            "patch holds NaN or infinity; give pixels without a surface as `reach`, and mark unseen ones by valid="
        )
    nearest, farthest = patches.min((1, 2)), patches.max((1, 2))
    if nearest.min() < -_INPUT_LIMITS.pixel_tolerance:
        raise ValueError(
            f"patch has negative pixels, down to {nearest.min():.3g}; it is metres behind the nearest point, so "
            "heights h above a plane are h.max() - h"
        )
    if farthest.max() > reach + max(_INPUT_LIMITS.pixel_tolerance, 1e-3 * reach):
        in_mm = farthest.max() <= 1e3 * reach * 1.001
        raise ValueError(
            f"patch has pixels of {farthest.max():.3g}, and it is metres behind the nearest point, at most {reach:g}; "
            + ("divide millimetres by 1000" if in_mm else "clip it there")
        )
    empty = nearest >= reach - _INPUT_LIMITS.pixel_tolerance
    if empty.any():
        raise ValueError(
            f"patch shows no surface{_which(empty)}: all pixels are at the reach, so the skin would touch nothing"
        )
    late = nearest > _INPUT_LIMITS.max_nearest_pixel
    if late.any():
        raise ValueError(
            f"patch begins {1e3 * nearest.max():.3g} mm behind its nearest point{_which(late)}; it counts from that "
            "point: subtract patch.min(), or turn heights over: h.max() - h"
        )
    return patches


def checked_views(view: Any, patches: Float[np.ndarray, "n p p"], reach: float) -> Float[np.ndarray, "n w w"]:
    """Check the views that a user gives with patches.

    Args:
        view: Depths (w, w) or (n, w, w) in m, for w pixels along an edge, each of the size of the patches' pixels;
            negative where the object stands out in front of the patch's nearest point, NaN where the rim is unknown.
        patches: The patches, each the middle of its view.
        reach: Depth (m) at which the patches are clipped.

    Returns:
        `(n, w, w)` views (m).

    Raises:
        ValueError: Shape or values do not fit the patches.
    """
    n, pixels = patches.shape[:2]
    views = _many("view", view, "metres behind the patch's nearest point")
    if views.ndim != 3 or len(views) != n or views.shape[1] != views.shape[2] or views.shape[1] < pixels:
        raise ValueError(
            f"view has shape {np.shape(view)}; give ({n}, w, w) with w at least the {pixels} pixels of a patch"
        )
    middle = centre(views, pixels)
    if not np.isfinite(middle).all():
        raise ValueError("view is NaN or infinite where the patch is; give what the camera saw there, or leave it out")
    if np.nanmax(views) > reach + max(_INPUT_LIMITS.pixel_tolerance, 1e-3 * reach) or np.isinf(views).any():
        raise ValueError(
            f"view has pixels of {np.nanmax(views):.3g}, and it is metres behind the patch's nearest point, at most "
            f"{reach:g}; clip it there, or divide millimetres by 1000"
        )
    other = np.quantile(np.abs(np.clip(middle, 0, reach) - patches), 0.9, axis=(1, 2)) > _INPUT_LIMITS.max_centre_error
    if other.any():
        raise ValueError(
            f"view differs from the patch in its middle{_which(other)}, or has pixels of another size; its middle must "
            "be the patch"
        )
    return views


def checked_column(
    name: str, values: Any, n: int, default: float | None, *, unknown: bool = False
) -> Float[np.ndarray, " n"]:
    """Check a user's values of a quantity, one for each of n touches.

    Args:
        name: Name of the quantity, for messages.
        values: One value for all touches, or one for each; None if the user gave none.
        n: Number of touches.
        default: Value to use if the user gave none; None for NaN.
        unknown: Whether a value may be NaN.

    Returns:
        `(n,)` values, NaN where there is neither a value nor a default.

    Raises:
        ValueError: Values are not finite, or their number is wrong.
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
    travel: Float[np.ndarray, " n"],
    *,
    usual_force: float,
    largest_force: float | None = None,
    least_force: float = 0.0,
) -> list[str]:
    """Refuse presses that no skin makes or that are far beyond a model's training.

    Args:
        force: Forces (N) along tool z, positive for a press.
        travel: Travel (m) past first contact; NaN where it is unknown.
        usual_force: Median force (N) of the training touches.
        largest_force: Largest force (N) of the training touches; None if it is unknown.
        least_force: Least force (N) of the training touches; 0 if it is unknown.

    Returns:
        A doubt in words if a press is harder, or much lighter, than those of the training.

    Raises:
        ValueError: A force pulls, presses nothing, breaks a skin or is far beyond the training touches, or a travel is
            not in metres.
    """
    validation.forces("force", force)
    trained = largest_force or _INPUT_LIMITS.unknown_force_ratio * usual_force
    about = f"presses of at most {trained:.2g} N" if largest_force else f"presses of about {usual_force:.2g} N"
    hardest, allowed = float(force.max()), _INPUT_LIMITS.max_force_ratio * trained
    if trained and hardest > allowed:
        raise ValueError(
            f"force is {hardest:g} N, and the model was trained on {about}: it cannot predict such a hard press; "
            f"give at most {allowed:.2g} N, or train on harder presses"
        )
    longest = np.max(np.abs(travel), initial=0.0, where=np.isfinite(travel))
    if longest > _INPUT_LIMITS.max_travel:
        raise ValueError(f"travel is {longest:g} m, more than {_INPUT_LIMITS.max_travel:g}; give metres")
    if trained and hardest > trained:
        return [f"force is {hardest:g} N, and the model was trained on {about}"]
    if (lightest := float(force.min())) < _INPUT_LIMITS.range_margin * least_force:
        return [f"force is {lightest:g} N, and the model was trained on presses of at least {least_force:.2g} N"]
    return []


def known_range(metadata: dict[str, Any] | None, name: str) -> list[float]:
    """Read a range of the training touches.

    Args:
        metadata: Provenance of a predictor.
        name: Name of the range, such as "force_range".

    Returns:
        Least and largest value; empty if they are unknown.
    """
    limits = (metadata or {}).get(name)
    numbers = [float(x) for x in limits if isinstance(x, int | float)] if isinstance(limits, list) else []
    return numbers if len(numbers) == 2 else []


def unlike_training(
    metadata: dict[str, Any] | None,
    patches: Float[np.ndarray, "n p p"],
    reach: float,
    travel: Float[np.ndarray, " n"],
    mean: Float[np.ndarray, "n c"],
) -> list[str]:
    """Compare touches with those of the training.

    Args:
        metadata: Provenance of the predictor, with the ranges of the training touches.
        patches: Patches (m).
        reach: Depth (m) at which they are clipped.
        travel: Travel (m) past first contact; NaN where it is unknown.
        mean: Predicted readings (uT).

    Returns:
        A doubt in words for each quantity that is far outside the training: travel, mean depth of a patch, largest
        value of a reading.
    """
    doubts = []
    share, depth_margin = _INPUT_LIMITS.range_margin, _INPUT_LIMITS.mean_depth_margin * reach
    for name, subject, values, least_margin in (
        ("travel_range", "travel is", travel, _INPUT_LIMITS.pixel_tolerance),
        ("mean_depth_range", "patch has a mean depth of", patches.mean((1, 2)), depth_margin),
    ):
        if limits := known_range(metadata, name):
            width = limits[1] - limits[0]
            above = max(share * width, least_margin)
            below = max(share * min(width, abs(limits[0])), least_margin)
            outside = (values < limits[0] - below) | (values > limits[1] + above)
            if outside.any():
                doubts.append(
                    f"{subject} {_mm(float(values[outside][0]))} mm{_which(outside)}, and the model was trained on "
                    f"{_mm(limits[0])} to {_mm(limits[1])} mm"
                )
    largest = (metadata or {}).get("largest_reading")
    predicted = np.abs(mean).max(1)
    if isinstance(largest, int | float) and predicted.max() > _INPUT_LIMITS.max_reading_ratio * largest:
        doubts.append(
            f"a predicted value is {predicted.max():.3g} uT, and the largest one of the training touches {largest:.3g}"
        )
    return doubts


def check_met(
    nearest: Float[np.ndarray, " n"],
    view: Float[np.ndarray, "n w w"] | None,
    pitch: float,
    *,
    remedy: str,
    warn: bool = True,
    stacklevel: int = 3,
) -> None:
    """Refuse touches whose skin does not lie on the surface. Warn of touches that meet nothing, or that first meet
    something next to the patch.

    Args:
        nearest: Signed distances (m) of the patches' nearest points from the tool origin; NaN where unknown.
        view: Views (m); None if there are only patches.
        pitch: Edge (m) of a pixel.
        remedy: Advice to the user, for the message.
        warn: Whether to warn as well.
        stacklevel: Stack level of the warnings.

    Raises:
        ValueError: The surface begins more than 10 mm in front of the skin, or behind it.
    """
    stands_out = np.zeros(len(nearest))
    if view is not None:
        on_skin = centre(np.asarray(view), min(pixels_on_skin(pitch), view.shape[-1]))
        stands_out = np.maximum(-np.nanmin(on_skin, axis=(1, 2)), 0.0)
    gap = np.nan_to_num(nearest - stands_out)
    worst = int(gap.argmax())
    if gap[worst] > _INPUT_LIMITS.max_gap:
        raise ValueError(
            f"the surface begins {_mm(float(gap[worst]))} mm in front of the skin at this pose"
            f"{_which(gap > _INPUT_LIMITS.max_gap)}; {remedy}"
        )
    behind = nearest < -_INPUT_LIMITS.max_gap
    if behind.any():
        raise ValueError(
            f"the surface begins {_mm(float(-np.nanmin(nearest)))} mm behind the skin at this pose"
            f"{_which(behind)}: the object is in the way, as in a cup, or tool z points away from the object instead "
            f"of into it; {remedy}"
        )
    if warn and gap[worst] > _INPUT_LIMITS.unnoticed_gap:
        warnings.warn(
            f"the surface begins {1e3 * gap[worst]:.3g} mm in front of the skin at this pose"
            f"{_which(gap > _INPUT_LIMITS.unnoticed_gap)}: a press that ends there meets nothing and reads zero; the "
            "prediction is for a skin that moves on until it presses",
            stacklevel=stacklevel,
        )
    if warn and stands_out.max() > _INPUT_LIMITS.unnoticed_gap:
        warnings.warn(
            f"the object stands out by {1e3 * stands_out.max():.3g} mm next to the patch and under the skin's rim at "
            "this pose: the skin meets it first, and the prediction is the reading of a press on it",
            stacklevel=stacklevel,
        )


def checked_valid(valid: Any, shape: tuple[int, ...]) -> Bool[np.ndarray, "n p p"]:
    """Check the mask of seen pixels that a user gives.

    Args:
        valid: Booleans (p, p) or (n, p, p), for p pixels along an edge.
        shape: Shape of the patches, (p, p) or (n, p, p).

    Returns:
        `(n, p, p)` mask of seen pixels.

    Raises:
        ValueError: The mask does not fit the patches, or hardly any pixel of a patch was seen.
    """
    mask, shape = np.asarray(valid), shape if len(shape) == 3 else (1, *shape)
    mask = np.broadcast_to(mask, shape) if mask.ndim == 2 and mask.shape == shape[1:] else mask
    if mask.dtype != np.bool_ or mask.shape != shape:
        raise ValueError(f"valid is {mask.dtype} {np.shape(valid)}; give booleans, one for each pixel of the patch")
    seen = mask.mean((1, 2))
    if not seen.all():
        raise ValueError(
            f"no pixel of the patch was seen{_which(seen == 0)}: it lies in a hole of the depth image or outside the "
            f"image, or the surface is more than {1e3 * STANDOFF:g} mm behind the skin; look again, or correct pose "
            "and unit"
        )
    if seen.min() < _INPUT_LIMITS.min_seen_fraction:
        raise ValueError(
            f"only {100 * seen.min():.0f} % of the patch was seen{_which(seen < _INPUT_LIMITS.min_seen_fraction)}, too "
            "little for a prediction; look again, from another side"
        )
    if seen.min() < _INPUT_LIMITS.warned_seen_fraction:
        warnings.warn(f"only {100 * seen.min():.0f} % of the patch was seen; the rest is guessed", stacklevel=3)
    return mask


def fill_unseen(
    patches: Float[np.ndarray, "n p p"], valid: Bool[np.ndarray, "*n p p"], reach: float
) -> tuple[Float[np.ndarray, "n p p"], Float[np.ndarray, "n p p"]]:
    """Fill unseen pixels in two ways: with emptiness, and with the depth of the nearest seen pixel.

    Args:
        patches: Patches (m).
        valid: Mask of seen pixels, with at least one in each patch.
        reach: Depth (m) of a pixel without a surface.

    Returns:
        `(n, p, p)` patches with empty unseen pixels, and `(n, p, p)` patches in which the surface continues (m).
    """
    mask = np.broadcast_to(valid, patches.shape)
    nearest = [ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True) for seen in mask]
    continued = np.stack([patch[tuple(index)] for patch, index in zip(patches, nearest, strict=True)])
    return np.where(mask, patches, np.float32(reach)), continued


def in_middle(views: Float[np.ndarray, "n w w"], patches: Float[np.ndarray, "n p p"]) -> Float[np.ndarray, "n w w"]:
    """Put patches into the middles of views.

    Args:
        views: Views (m).
        patches: Patches (m), with pixels of the same size.

    Returns:
        `(n, w, w)` copies of the views with the patches in their middles.
    """
    changed = views.copy()
    centre(changed, patches.shape[1])[:] = patches
    return changed


def checked_poses(T_o_t: Any) -> Float[np.ndarray, "n 4 4"]:
    """Check the tool poses that a user gives.

    Args:
        T_o_t: Poses (4, 4) or (n, 4, 4).

    Returns:
        `(n, 4, 4)` poses.

    Raises:
        ValueError: A pose is not a rigid transform.
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
        mesh: Any object with vertices.

    Raises:
        ValueError: The mesh is larger than any object that a tool touches.
    """
    vertices = np.asarray(getattr(mesh, "vertices", np.zeros((1, 3))), np.float64).reshape(-1, 3)
    size = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
    if size > MAX_SIZE_M:
        raise ValueError(
            f"mesh is {size:.3g} m across, but its vertices must be in metres: i2t.load_mesh(file, 'mm') converts a "
            "file; scale a mesh by 1e-3"
        )


def check_in_front(surface: Surface, T_o_t: Float[np.ndarray, "4 4"], view: PatchView, window: float) -> None:
    """Refuse a pose whose skin does not lie on the surface, and warn of a pose whose skin first meets something else.

    Args:
        surface: The touched surface, in W.
        T_o_t: Pose of the tool.
        view: The view in front of the tool.
        window: Edge (m) of the patch.

    Raises:
        ValueError: No surface is in front of the skin, the skin is away from it or inside the object, or its z points
            away from it.
    """
    nearest = float(view.patch.nearest)
    if not math.isfinite(nearest):
        raise ValueError("nothing lies in front of the skin's middle at this pose; move T_o_t towards the surface")
    pitch = window / len(view.patch.depth)
    remedy = (
        "move T_o_t onto it (i2t.contact_pose), in the mesh's frame (i2t.load_mesh moves a mesh to the table; "
        "table=False keeps its file's frame)"
    )
    triangles = np.asarray(surface.triangles, np.float64)
    depth = np.asarray(view.patch.depth)
    row, column = np.unravel_index(int(depth.argmin()), depth.shape)
    # A ray through a pixel's centre would meet edges of symmetric meshes.
    x, y = ((np.array([column, row]) + np.array([0.537, 0.471])) / len(depth) - 0.5) * window
    line = _crossings(triangles, T_o_t, float(x), float(y))
    middle = _crossings(triangles, T_o_t, 1.7e-5, 1.1e-5)  # next to the tool's axis
    middle_inside = _starts_inside(middle)
    on_surface = bool((abs(middle.height) < _INPUT_LIMITS.unnoticed_gap).any()) and not middle_inside
    if on_surface and (_starts_inside(line) or nearest < -_INPUT_LIMITS.max_gap):
        raise ValueError(
            f"a part of the object within the skin's {1e3 * PAD_WINDOW:g} mm stands out by "
            f"{_mm(-float(line.height.min(initial=nearest)))} mm at this pose, so the skin cannot lie on the surface "
            "there; choose a point farther from it"
        )
    check_met(np.array([nearest]), np.asarray(view.depth)[None], pitch, remedy=remedy, stacklevel=5)
    if middle_inside or _starts_inside(line):
        raise ValueError(
            "the skin would meet the surface from inside the object at this pose: it lies in the object, or tool z "
            "points out of it; make T_o_t with i2t.contact_pose"
        )


class Crossings(NamedTuple):
    """Crossings of a line along tool z with a surface, in the order of their heights."""

    height: Float[np.ndarray, " n"]  # m along tool z from the tool origin
    leaves: Bool[np.ndarray, " n"]  # whether the line leaves the object through the face


def _crossings(triangles: np.ndarray, T_o_t: np.ndarray, x: float, y: float) -> Crossings:
    """Intersect the line along tool z through (x, y) in the tool frame with (n, 3, 3) triangles."""
    rotation, origin = T_o_t[:3, :3].astype(np.float64), T_o_t[:3, 3].astype(np.float64)
    a, b, c = np.moveaxis((triangles - origin) @ rotation - np.array([x, y, 0.0]), 1, 0)

    def twice_area(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]

    parts = np.stack([twice_area(b, c), twice_area(c, a), twice_area(a, b)])
    whole = parts.sum(0)
    crossed = ((parts > 0).all(0) | (parts < 0).all(0)) & (whole != 0)
    height = (parts * np.stack([a, b, c])[:, :, 2]).sum(0)[crossed] / whole[crossed]
    order = np.argsort(height)
    return Crossings(height[order], (whole[crossed] > 0)[order])


def _starts_inside(line: Crossings) -> bool:
    """Test whether a ray along tool z starts inside bodies that are closed and face outward along the whole line.
    Return False for other surfaces, where it is unknown.
    """
    within = np.cumsum(np.where(line.leaves, -1, 1))  # number of bodies that hold the line after each crossing
    closed = len(within) > 0 and within.min() >= 0 and within[-1] == 0
    before = within[line.height <= -STANDOFF]
    return bool(closed and len(before) and before[-1] > 0)


def _many(name: str, values: Any, hint: str) -> np.ndarray:
    """Convert images or transforms of one or many touches to an array with touches on axis 0."""
    array = validation.numbers(name, values, hint).astype(np.float32)
    return array[None] if array.ndim == 2 else array


def _mm(length: float) -> str:
    """Write a length (m) in millimetres to three digits, without an exponent."""
    return f"{float(f'{1e3 * length:.3g}'):.10g}"


def _which(touches: Bool[np.ndarray, " n"]) -> str:
    """Name the first touch that a message is about."""
    return "" if len(touches) == 1 else f" (touch {int(np.flatnonzero(touches)[0])})"
