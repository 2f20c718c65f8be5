"""Scores of the inferred patch of a press, one touch at a time, and their means over touches."""

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

THRESHOLDS = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)  # of a probability, above which a pixel is said to belong to a mask
COARSE = 2  # pixels of a patch to one that is scored by CRPS and coverage
DRAWS = 64  # samples of which these are computed
EDGE_ANGLES, EDGE_OFFSETS = 120, 69  # tried, of a half-plane: 3 degrees and a quarter of a millimetre apart
STRAIGHT, EDGE_SHARE = 0.95, 0.1  # a mask that a half-plane explains so far, and that leaves so much on either side
SLOPE_SHARE = 0.1  # of the window, that lies on the way down: more is a tilted plane, and no edge
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9)  # of the intervals whose coverage is counted
MM = 1e3


def score_touch(
    touch: tuple[Array, Array, MetSurface], *, library: PatchLibrary, blur: float | Array
) -> dict[str, Array]:
    """Scores of one touch: the weights of the library's patches, the force at its last stop, and what was met."""
    weight, force, truth = touch
    found = summarize(weight, force, library=library, blur=blur)
    stride = len(found.rows) // DRAWS
    draws = jnp.sort(found.patch[::stride, ::COARSE, ::COARSE].astype(jnp.float32), axis=0)
    true = truth.patch[::COARSE, ::COARSE]
    rank = 2 * jnp.arange(DRAWS) - DRAWS + 1
    spread = jnp.einsum("k,kij->ij", rank.astype(jnp.float32), draws) / DRAWS**2
    crps = jnp.mean(jnp.abs(draws - true[None]), axis=0) - spread
    # Between the order statistics e and n - 1 - e of n draws lies another with probability (n - 1 - 2 e) / (n + 1).
    ends = [round((1 - level) / 2 * (DRAWS + 1) - 1) for level in LEVELS]
    inside = jnp.stack([(draws[e] - 1e-5 <= true) & (true <= draws[DRAWS - 1 - e] + 1e-5) for e in ends])
    return {
        "mask": _ious(found.mask_probability, truth.patch <= CONTACT_TOLERANCE_M),
        "contact": _ious(found.contact_probability.ravel(), truth.contact),
        "crps_mm": MM * jnp.mean(crps),
        "covered": _coverage(inside, truth.contact),
        "edge": _edge_errors(found.mask_probability[::COARSE, ::COARSE], true),
        "centre_mm": MM * jnp.linalg.norm(found.centre - truth.centre),
    }


def edge_of(mask: Array) -> tuple[Array, Array, Array]:
    """The half-plane that a mask, or the probability of one, resembles most.

    Returns:
        Direction (rad) of its outward normal in the tool frame, offset (m) of its edge from the middle along that, and
        how much of the window it explains: 1 for a mask that is a half-plane.
    """
    at = ((jnp.arange(len(mask)) + 0.5) / len(mask) - 0.5) * PATCH_WINDOW
    angles = jnp.linspace(0, 2 * jnp.pi, EDGE_ANGLES, endpoint=False)
    along = jnp.cos(angles)[:, None, None] * at[None, None, :] + jnp.sin(angles)[:, None, None] * at[None, :, None]
    offsets = jnp.linspace(-0.5, 0.5, EDGE_OFFSETS) * PATCH_WINDOW

    def explained(offset: Array) -> Array:
        inside = along <= offset
        return jnp.mean(jnp.where(inside, mask, 1 - mask), axis=(1, 2))

    found = jax.lax.map(explained, offsets)
    offset, angle = jnp.unravel_index(jnp.argmax(found), found.shape)
    return angles[angle], offsets[offset], jnp.max(found)


def _edge_errors(probability: Array, depth: Array) -> Array:
    """Errors of direction (degrees) and offset (mm) of an edge; NaN where what was met is no straight, steep edge."""
    true = depth <= CONTACT_TOLERANCE_M
    angle, offset, straight = edge_of(true.astype(jnp.float32))
    found_angle, found_offset, _ = edge_of(probability)
    turn = jnp.abs((found_angle - angle + jnp.pi) % (2 * jnp.pi) - jnp.pi)
    share = jnp.mean(true)
    is_steep = jnp.mean(~true & (depth <= 2 * CONTACT_TOLERANCE_M)) < SLOPE_SHARE
    is_edge = (straight > STRAIGHT) & is_steep & (share > EDGE_SHARE) & (share < 1 - EDGE_SHARE)
    return jnp.where(is_edge, jnp.stack([jnp.degrees(turn), MM * jnp.abs(found_offset - offset)]), jnp.nan)


def _ious(probability: Array, true: Array) -> Array:
    """Intersection over union at each threshold."""
    said = probability[None] > jnp.asarray(THRESHOLDS).reshape(-1, *[1] * probability.ndim)
    axes = tuple(range(1, said.ndim))
    both, either = jnp.sum(said & true[None], axes), jnp.sum(said | true[None], axes)
    return jnp.where(either > 0, both / jnp.maximum(either, 1), 1.0)


def _coverage(inside: Array, contact: Array) -> Array:
    """Share of the pixels in contact whose depth lies in each interval; NaN where no pixel is in contact."""
    at = ((np.arange(PATCH_PIXELS)[::COARSE] + 0.5) / PATCH_PIXELS - 0.5) * PATCH_WINDOW
    cells = round(contact.shape[0] ** 0.5)
    cell = np.clip(((at / PAD_WINDOW + 0.5) * cells).astype(int), 0, cells - 1)
    pixel = contact.reshape(cells, cells)[cell][:, cell]
    count = jnp.sum(pixel)
    return jnp.where(count > 0, jnp.sum(inside & pixel[None], (1, 2)) / jnp.maximum(count, 1), jnp.nan)


def choose_thresholds(scores: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Choose those of `THRESHOLDS` with the best masks on validation objects."""
    return {name: int(np.argmax(scores[name].mean(0))) for name in ("mask", "contact")}


def report_of(
    scores: Mapping[str, np.ndarray],
    prior: Mapping[str, np.ndarray],
    chosen: Mapping[str, Any],
    chosen_prior: Mapping[str, Any],
    clusters: Sequence[np.ndarray],
) -> dict[str, list[float]]:
    """Means and quantiles over touches, with intervals over objects and pads.

    Args:
        scores: Of a method, at every touch.
        prior: Of the prior, at the same touches.
        chosen: The method's thresholds.
        chosen_prior: The prior's.
        clusters: Each touch's object and pad.
    """
    mask, mask_prior = scores["mask"][:, chosen["mask"]], prior["mask"][:, chosen_prior["mask"]]

    def mean(values: np.ndarray) -> list[float]:
        rows = np.isfinite(values)
        return numbers(cluster_interval(values[rows], [label[rows] for label in clusters]))

    def ratio(weight: np.ndarray) -> np.ndarray:
        return (weight @ scores["crps_mm"]) / (weight @ prior["crps_mm"])

    def skill(weight: np.ndarray) -> np.ndarray:
        """Share of what the prior leaves open."""
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
    """The least value that has so much of the weight at or below it."""
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return np.asarray(values[order][min(np.searchsorted(total, level * total[-1]), len(values) - 1)])


def score_table(head: str, columns: Mapping[str, str], methods: Mapping[str, Mapping[str, Any]]) -> str:
    """The main numbers of all methods as text; `columns` are titles by the names of scores."""
    rows = (
        [name, *(f"{found[column][0]:.3f}" if column in found else "-" for column in columns)]
        for name, found in methods.items()
    )
    return text_table([head, *columns.values()], rows)


def numbers(estimate: Any) -> list[float]:
    """Mean, lower and upper limit, as JSON takes them."""
    return [round(float(part), 4) for part in estimate]
