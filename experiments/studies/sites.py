"""Information of a first touch of a flat, of an edge and of a corner."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.runs import Part
from experiments.studies.lab import Column, StudyLab, clusters_of, format_estimate, make_table, pool_parts
from i2t.geometry import inverse
from i2t.recognition import metrics
from i2t.recognition.episodes import EVIDENCE, run_belief
from i2t.recognition.intervals import mean_interval, rows_of
from i2t.recognition.metrics import to_json
from i2t.rendering.render import render_heights
from i2t.types import PAD_WINDOW, Surface

MAP_PIXELS = 20  # over the skin
CONTACT_DEPTH_M = 1e-3  # what lies so near to a contact's nearest point is pressed

# Shares of the skin under which the surface is pressed: an edge through the middle has a half, a corner a quarter.
SHARES = {"flat": (0.95, 1.01), "edge": (0.375, 0.95), "corner or narrow": (0.0, 0.375)}


def evaluate(lab: StudyLab) -> Part:
    """Episodes of a single touch, and the share of the skin that each pressed."""
    key_sites, key_episodes = jax.random.split(lab.key)
    plan = lab.plan(key_sites, truth=lab.truth(1 if lab.args.debug else lab.cfg.touches), touches=1)
    particles = lab.particles()
    (table,) = lab.predict(plan.sites, particles, [lab.pad_model.reading_model], "sites")
    episodes = lab.simulate(key_episodes, plan, "sites")
    shares = jax.jit(jax.vmap(pressed_share, (None, 0)))
    share = np.stack([np.asarray(shares(surface, plan.sites.T_w_t)) for surface in lab.surfaces], 1)
    beliefs = run_belief(table, episodes, lab.pad_model.likelihood, particles)
    contact = np.asarray(episodes.observations.contact)[:, 0]
    return {
        "truth": plan.truth,
        "pool": plan.pool,
        "share": share[plan.chosen[:, 0], plan.truth],
        "contact": contact,
        **beliefs,
    }


def pressed_share(surface: Surface, T_w_site: jax.Array) -> jax.Array:
    """Share of the skin under which the surface lies within `CONTACT_DEPTH_M` of its nearest point."""
    heights = render_heights(surface, inverse(T_w_site), PAD_WINDOW, MAP_PIXELS)
    return jnp.mean(heights <= jnp.min(heights) + CONTACT_DEPTH_M)


def report(parts: Sequence[Part], out: Path, pads: Sequence[str]) -> dict[str, Any]:
    """Bits of information for each kind of site and of evidence."""
    columns, clusters = pool_parts(parts), clusters_of(parts, pads)
    counted = [kind for kind in EVIDENCE if kind in columns]  # those of an earlier version may lack some
    contact, share = columns["contact"], columns["share"]
    kinds = {"air": ~contact} | {
        name: contact & (share >= low) & (share < high) for name, (low, high) in SHARES.items()
    }
    result: dict[str, Any] = {"touches": len(columns["truth"]), "bits": {}}
    table: list[list[Any]] = []
    for name, rows in kinds.items():
        result["bits"][name] = {"touches": int(rows.sum())}
        line = []
        for kind in counted if rows.any() else ():
            information = information_bits(columns[kind][rows, 0], columns["truth"][rows])
            bits = mean_interval(information, rows_of(clusters, rows))
            result["bits"][name][kind] = to_json(bits)
            line.append(f"{kind} {format_estimate(bits)}")
        table.append([name, str(rows.sum()), *(result["bits"][name].get(kind, "-") for kind in counted)])
        print(f"{name:18} {rows.sum():5d} touches, bits: " + "   ".join(line))
    result["tables"] = {"bits": make_table(["met", "touches", *(Column(kind, 2) for kind in counted)], table)}
    return result


def information_bits(p: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Information of each touch, in bits: how much the probability of the truth grew over that of guessing. Its mean is
    the information as far as the belief is calibrated.
    """
    right = p.astype(np.float64)[np.arange(len(p)), truth]
    return np.log2(np.clip(right, metrics.PROBABILITY_FLOOR, 1) * p.shape[1])
