"""Scores of the inferred patch of a press, one touch at a time."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from i2t.recognition.intervals import bootstrap_clusters, cluster_interval
from i2t.reconstruction.local_shape import PatchLibrary, summarize
from i2t.types import CONTACT_TOLERANCE_M, PAD_WINDOW, PATCH_PIXELS, PATCH_WINDOW, Array

THRESHOLDS = (0.2, 0.3, 0.4, 0.5)  # of a probability, above which a pixel is said to belong to a mask
COARSE = 2  # pixels of a patch to one that is scored by CRPS and coverage
DRAWS = 64  # samples of which these are computed
LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9)  # of the intervals whose coverage is counted
MM = 1e3


class MetSurface(NamedTuple):
    """The surface that a press met; one touch, or many on axis 0."""

    patch: Array  # (p, p) m
    contact: Array  # (cells,) at the last stop
    centre: Array  # (2,) m, of pressure there
    edge: Array  # (4,), as of a PatchLibrary
    kind: Array  # index into CONTACT_CLASSES


def score_weights(
    weight: Array, force: Array, truth: MetSurface, library: PatchLibrary, blur: float
) -> dict[str, Array]:
    """Scores of weights of the library's patches."""
    found = summarize(weight, force, library=library, blur=blur)
    stride = len(found.rows) // DRAWS
    draws = jnp.sort(found.patch[::stride, ::COARSE, ::COARSE].astype(jnp.float32), axis=0)
    true = truth.patch[::COARSE, ::COARSE]
    rank = 2 * jnp.arange(DRAWS) - DRAWS + 1
    spread = jnp.einsum("k,kij->ij", rank.astype(jnp.float32), draws) / DRAWS**2
    crps = jnp.mean(jnp.abs(draws - true[None]), axis=0) - spread
    ends = [round((1 - level) / 2 * (DRAWS - 1)) for level in LEVELS]
    inside = jnp.stack([(draws[e] - 1e-5 <= true) & (true <= draws[DRAWS - 1 - e] + 1e-5) for e in ends])
    turn = jnp.abs(found.edge_direction - 0.5 * jnp.mod(jnp.arctan2(truth.edge[1], truth.edge[0]), 2 * jnp.pi))
    normal = jnp.stack([-jnp.sin(found.edge_direction), jnp.cos(found.edge_direction)])
    return {
        "mask": _ious(found.mask_probability, truth.patch <= CONTACT_TOLERANCE_M),
        "contact": _ious(found.contact_probability.ravel(), truth.contact),
        "crps_mm": MM * jnp.mean(crps),
        "covered": _coverage(inside, truth.contact),
        "centre_mm": MM * jnp.linalg.norm(found.centre - truth.centre),
        "direction_deg": jnp.degrees(jnp.minimum(turn, jnp.pi - turn)),
        "position_mm": MM * jnp.abs(jnp.dot(normal, truth.edge[2:]) - found.edge_offset),
        "class": (jnp.argmax(found.class_probability) == truth.kind).astype(jnp.float32),
        "weight_bits": found.bits,
    }


def score_pixels(mask: Array, depth: Array, std: Array, truth: MetSurface) -> dict[str, Array]:
    """Scores of a mask's probabilities and of independent normal depths (m) of coarse pixels."""
    true = truth.patch[::COARSE, ::COARSE]
    z = (true - depth) / std
    density, below = jax.scipy.stats.norm.pdf(z), jax.scipy.stats.norm.cdf(z)
    crps = std * (z * (2 * below - 1) + 2 * density - 1 / jnp.sqrt(jnp.pi))  # Gneiting et al., MWR 133, 2005
    wide = jax.scipy.stats.norm.ppf(0.5 + jnp.asarray(LEVELS) / 2)
    return {
        "mask": _ious(mask, true <= CONTACT_TOLERANCE_M),
        "crps_mm": MM * jnp.mean(crps),
        "covered": _coverage(jnp.abs(z)[None] <= wide[:, None, None], truth.contact),
    }


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


def report(
    scores: dict[str, np.ndarray],
    prior: dict[str, np.ndarray],
    truth: MetSurface,
    *,
    chosen: dict[str, Any],
    clusters: list[np.ndarray],
) -> dict[str, Any]:
    """Means and quantiles over touches, with intervals over objects and pads; `chosen` are a method's thresholds."""
    found: dict[str, Any] = {}

    def mean(name: str, values: np.ndarray) -> None:
        rows = np.isfinite(values)
        found[name] = numbers(cluster_interval(values[rows], [label[rows] for label in clusters]))

    def quantile(name: str, values: np.ndarray, rows: np.ndarray, level: float) -> None:
        kept = values[rows]

        def at(weight: np.ndarray) -> np.ndarray:
            order = np.argsort(kept)
            total = np.cumsum(weight[order])
            return kept[order][np.searchsorted(total, level * total[-1])]

        if len(kept):
            found[name] = numbers(bootstrap_clusters(at, [label[rows] for label in clusters], len(kept)))

    mean("mask_iou", scores["mask"][:, chosen["mask"]])
    crps = np.stack([scores["crps_mm"], prior["crps_mm"]], -1)

    def ratio(weight: np.ndarray) -> np.ndarray:
        return (weight @ crps[:, 0]) / (weight @ crps[:, 1])

    found["crps_ratio"] = numbers(bootstrap_clusters(ratio, clusters, len(crps)))
    for level, column in zip(LEVELS, scores["covered"].T, strict=True):
        mean(f"coverage_{round(100 * level)}", column)
    if "contact" in scores:
        mean("contact_iou", scores["contact"][:, chosen["contact"]])
        every, straight = np.ones(len(crps), bool), np.asarray(truth.kind) == 1
        quantile("centre_mm_median", scores["centre_mm"], every, 0.5)
        quantile("centre_mm_90", scores["centre_mm"], every, 0.9)
        quantile("direction_deg_median", scores["direction_deg"], straight, 0.5)
        quantile("position_mm_median", scores["position_mm"], straight, 0.5)
        mean("class_right", scores["class"])
    return found


def choose_thresholds(scores: dict[str, np.ndarray]) -> dict[str, int]:
    """Choose those of `THRESHOLDS` with the best masks on validation objects."""
    return {name: int(np.argmax(scores[name].mean(0))) for name in ("mask", "contact") if name in scores}


def numbers(estimate: Any) -> list[float]:
    """Mean, lower and upper limit, as JSON takes them."""
    return [round(float(part), 4) for part in estimate]
