"""What does a first touch tell on a flat, on an edge and on a corner?"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.studies.lab import Lab, imagine, placements_of, shown, sit
from i2t.geometry import inverse
from i2t.recognition import metrics as scores
from i2t.recognition.episodes import run_belief
from i2t.recognition.metrics import to_json
from i2t.recognition.site_pool import draw_random_sites, sample_sites
from i2t.rendering.render import render_heights
from i2t.types import PAD_WINDOW

PIXELS = 20  # over the skin
NEAR = 1e-3  # m: what lies so near to a contact's nearest point is pressed
# Shares of the skin under which the surface lies so near: an edge through the middle has a half, a corner a quarter.
KINDS = {"flat": (0.95, 1.01), "edge": (0.375, 0.95), "corner or narrow": (0.0, 0.375)}


def play(lab: Lab) -> dict[str, Any]:
    """Sittings of a single touch."""
    key_pool, key_play, key_site = jax.random.split(lab.key, 3)
    sites = sample_sites(key_pool, lab.surfaces, lab.names, lab.cfg.num_sites, lab.cfg.site_limits)
    places = placements_of(lab)
    (table,) = imagine(lab, sites, places, [lab.learnt.reading_model], "sites")
    each = lab.sittings * (1 if lab.args.preset == "debug" else lab.cfg.touches)
    truth = np.repeat(np.arange(len(lab.surfaces)), each)
    chosen = draw_random_sites(key_site, sites, len(truth), 1)
    episodes = sit(lab, key_play, sites, truth, chosen, "sites")
    look = jax.jit(jax.vmap(covered, (None, 0)))
    share = np.stack([np.asarray(look(surface, sites.T_w_t)) for surface in lab.surfaces], 1)
    told = run_belief(table, episodes, lab.learnt.likelihood, places)
    met = np.asarray(episodes.observations.contact)[:, 0]
    return {"truth": truth, "share": share[chosen[:, 0], truth], "met": met, **told}


def covered(surface: Any, T_w_site: jax.Array) -> jax.Array:
    """Share of the skin under which the surface lies within `NEAR` of the nearest point, at the believed place."""
    heights = render_heights(surface, inverse(T_w_site), PAD_WINDOW, PIXELS)
    return jnp.mean(heights <= jnp.min(heights) + NEAR)


def report(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Bits for each kind of place and of evidence."""
    columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    kinds = {"air": ~columns["met"]}
    for name, (low, high) in KINDS.items():
        kinds[name] = columns["met"] & (columns["share"] >= low) & (columns["share"] < high)
    result: dict[str, Any] = {"touches": len(columns["truth"]), "bits": {}}
    for name, rows in kinds.items():
        result["bits"][name] = {"touches": int(rows.sum())}
        said = []
        for kind in ("fused", "tactile only", "position only"):
            p = columns[kind][rows, 0].astype(np.float64)
            if not len(p):
                continue
            # What the truth gained, on average, is the information as far as the belief is calibrated.
            bits = np.log2(np.clip(p[np.arange(len(p)), columns["truth"][rows]], 1e-6, 1) * p.shape[1])
            gained = scores.student_interval(bits)
            result["bits"][name][kind] = to_json(gained)
            said.append(f"{kind} {shown(gained)}")
        print(f"{name:18} {rows.sum():5d} touches, bits: " + "   ".join(said))
    return result
