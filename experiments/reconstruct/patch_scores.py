"""Scores of the patch inferred from a press, and their means over touches."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.tables import text_table
from experiments.reconstruct.patch_world import MetSurface
from i2t.intervals import bootstrap_clusters, cluster_interval
from i2t.patches.dimensions import CONTACT_TOLERANCE_M, PAD_WINDOW, PATCH_PIXELS, PATCH_WINDOW
from i2t.reconstruction.local_shape import PatchLibrary, summarize
from i2t.types import Array

MASK_THRESHOLDS = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)  # candidate probabilities above which a pixel is in the mask
PIXEL_STRIDE = 2  # CRPS and coverage are computed on every second pixel
DRAWS = 64  # posterior samples for CRPS and coverage
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9)  # nominal levels of the intervals whose coverage is scored


def score_touch(
    touch: tuple[Array, Array, MetSurface], *, library: PatchLibrary, blur: float | Array
) -> dict[str, Array]:
    """Score one touch, given as posterior weights of the library's patches, force at the last stop, and truth."""
    weight, force, truth = touch
    posterior = summarize(weight, force, library=library, blur=blur)
    stride = len(posterior.rows) // DRAWS
    draws = jnp.sort(posterior.patch[::stride, ::PIXEL_STRIDE, ::PIXEL_STRIDE].astype(jnp.float32), axis=0)
    true = truth.patch[::PIXEL_STRIDE, ::PIXEL_STRIDE]
    rank = 2 * jnp.arange(DRAWS) - DRAWS + 1
    spread = jnp.einsum("k,kij->ij", rank.astype(jnp.float32), draws) / DRAWS**2
    crps = jnp.mean(jnp.abs(draws - true[None]), axis=0) - spread
    # A new draw is between the order statistics e and n - 1 - e of n draws with probability (n - 1 - 2 e) / (n + 1).
    ends = [round((1 - level) / 2 * (DRAWS + 1) - 1) for level in LEVELS]
    inside = jnp.stack([(draws[e] - 1e-5 <= true) & (true <= draws[DRAWS - 1 - e] + 1e-5) for e in ends])
    return {
        "mask": _ious(posterior.mask_probability, truth.patch <= CONTACT_TOLERANCE_M),
        "contact": _ious(posterior.contact_probability.ravel(), truth.contact),
        "crps_mm": 1e3 * jnp.mean(crps),
        "covered": _coverage(inside, truth.contact),
        "edge": _edge_errors(posterior.mask_probability[::PIXEL_STRIDE, ::PIXEL_STRIDE], true),
        "centre_mm": 1e3 * jnp.linalg.norm(posterior.centre - truth.centre),
    }


def edge_of(mask: Array) -> tuple[Array, Array, Array]:
    """Fit the half-plane that best matches a mask or a mask's probability.

    Args:
        mask: (p, p) mask or probability over the patch's window.

    Returns:
        Direction (rad) of the outward normal in the tool frame, offset (m) of the edge from the window's centre along
        the normal, and the fraction of the window that the half-plane explains, 1 for an exact half-plane.
    """
    at = ((jnp.arange(len(mask)) + 0.5) / len(mask) - 0.5) * PATCH_WINDOW
    angles = jnp.linspace(0, 2 * jnp.pi, 120, endpoint=False)
    along = jnp.cos(angles)[:, None, None] * at[None, None, :] + jnp.sin(angles)[:, None, None] * at[None, :, None]
    offsets = jnp.linspace(-0.5, 0.5, 69) * PATCH_WINDOW

    def explained(offset: Array) -> Array:
        inside = along <= offset
        return jnp.mean(jnp.where(inside, mask, 1 - mask), axis=(1, 2))

    matches = jax.lax.map(explained, offsets)
    offset, angle = jnp.unravel_index(jnp.argmax(matches), matches.shape)
    return angles[angle], offsets[offset], jnp.max(matches)


def _edge_errors(probability: Array, depth: Array) -> Array:
    """Errors of direction (degrees) and offset (mm) of an edge; NaN if the true patch has no straight, steep edge.

    An edge is a mask that a half-plane explains to 95 %, with a tenth of the window on either side. If a tenth of the
    window is just below the contact, the surface is a tilted plane and not an edge.
    """
    true = depth <= CONTACT_TOLERANCE_M
    angle, offset, straight = edge_of(true.astype(jnp.float32))
    inferred_angle, inferred_offset, _ = edge_of(probability)
    turn = jnp.abs((inferred_angle - angle + jnp.pi) % (2 * jnp.pi) - jnp.pi)
    share = jnp.mean(true)
    is_steep = jnp.mean(~true & (depth <= 2 * CONTACT_TOLERANCE_M)) < 0.1
    is_edge = (straight > 0.95) & is_steep & (share > 0.1) & (share < 0.9)
    return jnp.where(is_edge, jnp.stack([jnp.degrees(turn), 1e3 * jnp.abs(inferred_offset - offset)]), jnp.nan)


def _ious(probability: Array, true: Array) -> Array:
    """Intersection over union at each threshold."""
    predicted = probability[None] > jnp.asarray(MASK_THRESHOLDS).reshape(-1, *[1] * probability.ndim)
    axes = tuple(range(1, predicted.ndim))
    both, either = jnp.sum(predicted & true[None], axes), jnp.sum(predicted | true[None], axes)
    return jnp.where(either > 0, both / jnp.maximum(either, 1), 1.0)


def _coverage(inside: Array, contact: Array) -> Array:
    """Fraction of the pixels in contact whose depth is inside each interval; NaN if no pixel is in contact."""
    at = ((np.arange(PATCH_PIXELS)[::PIXEL_STRIDE] + 0.5) / PATCH_PIXELS - 0.5) * PATCH_WINDOW
    cells = round(contact.shape[0] ** 0.5)
    cell = np.clip(((at / PAD_WINDOW + 0.5) * cells).astype(int), 0, cells - 1)
    pixel = contact.reshape(cells, cells)[cell][:, cell]
    count = jnp.sum(pixel)
    return jnp.where(count > 0, jnp.sum(inside & pixel[None], (1, 2)) / jnp.maximum(count, 1), jnp.nan)


def choose_thresholds(scores: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Choose those of `MASK_THRESHOLDS` with the best masks on validation objects."""
    return {name: int(np.argmax(scores[name].mean(0))) for name in ("mask", "contact")}


def report_of(
    scores: Mapping[str, np.ndarray],
    prior: Mapping[str, np.ndarray],
    chosen: Mapping[str, Any],
    chosen_prior: Mapping[str, Any],
    clusters: Sequence[np.ndarray],
) -> dict[str, list[float]]:
    """Compute means and quantiles over touches, with intervals over objects and pads.

    Args:
        scores: Scores of a method at every touch.
        prior: Scores of the prior at the same touches.
        chosen: Indices of the method's mask thresholds.
        chosen_prior: Indices of the prior's mask thresholds.
        clusters: Object and pad of each touch.

    Returns:
        Value, lower end and upper end of each score's 95 % interval, by name of the score.
    """
    mask, mask_prior = scores["mask"][:, chosen["mask"]], prior["mask"][:, chosen_prior["mask"]]

    def mean(values: np.ndarray) -> list[float]:
        rows = np.isfinite(values)
        return numbers(cluster_interval(values[rows], [label[rows] for label in clusters]))

    def ratio(weight: np.ndarray) -> np.ndarray:
        return (weight @ scores["crps_mm"]) / (weight @ prior["crps_mm"])

    def skill(weight: np.ndarray) -> np.ndarray:
        """Fraction of the prior's shortfall from IoU 1 that the method removes."""
        return (weight @ (mask - mask_prior)) / (weight @ (1 - mask_prior))

    def quantile(values: np.ndarray, level: float = 0.5) -> list[float]:
        rows = np.isfinite(values)
        if not rows.any():
            return [float("nan")] * 3
        labels = [label[rows] for label in clusters]
        return numbers(bootstrap_clusters(partial(weighted_quantile, values[rows], level), labels, int(rows.sum())))

    return {
        "mask_iou": mean(mask),
        "mask_skill": numbers(bootstrap_clusters(skill, clusters, len(mask))),
        "contact_iou": mean(scores["contact"][:, chosen["contact"]]),
        "centre_mm_median": quantile(scores["centre_mm"]),
        "centre_mm_90": quantile(scores["centre_mm"], 0.9),
        "edge_degrees_median": quantile(scores["edge"][:, 0]),
        "edge_mm_median": quantile(scores["edge"][:, 1]),
        "crps_mm": mean(scores["crps_mm"]),
        "crps_ratio": numbers(bootstrap_clusters(ratio, clusters, len(scores["crps_mm"]))),
        **{f"coverage_{100 * level:.0f}": mean(scores["covered"][:, i]) for i, level in enumerate(LEVELS)},
    }


def weighted_quantile(values: np.ndarray, level: float, weight: np.ndarray) -> np.ndarray:
    """Smallest value with at least the fraction `level` of the weight at or below it."""
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return np.asarray(values[order][min(np.searchsorted(total, level * total[-1]), len(values) - 1)])


def score_table(head: str, columns: Mapping[str, str], methods: Mapping[str, Mapping[str, Any]]) -> str:
    """Format the main scores of all methods; `columns` maps scores to column titles."""
    rows = (
        [name, *(f"{scores[column][0]:.3f}" if column in scores else "-" for column in columns)]
        for name, scores in methods.items()
    )
    return text_table([head, *columns.values()], rows)


def numbers(estimate: Any) -> list[float]:
    """Mean, lower and upper limit as rounded floats for JSON."""
    return [round(float(part), 4) for part in estimate]
