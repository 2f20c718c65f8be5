"""How many presses does a pad need that was never felt? It is pressed with a known ball, a pad is fitted to what it
reads (`i2t.calibration.physics`), and what the fitted pad would feel on the training objects is simulated and learnt.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from experiments.studies.lab import Lab, imagine, placements_of, sit
from i2t.calibration.physics import RoundTip, fit_pad
from i2t.calibration.structured_gp import Presses
from i2t.recognition.episodes import run_belief
from i2t.recognition.site_pool import draw_random_sites, sample_sites
from i2t.skin.boards import reskin_board
from i2t.skin.contact import GRID
from i2t.skin.noise import Noise, add_sensor_noise
from i2t.skin.pad import press_force, sample_pad
from i2t.types import Pad

PRESSES = (5, 20, 100)
BALL = RoundTip("sphere", 4e-3)


def play(lab: Lab) -> dict[str, Any]:
    """The same sittings with a pad that was never felt, which is known better and better."""
    key_pool, key_play, key_site, key_fit = jax.random.split(lab.key, 4)
    other = sample_pad(jax.random.key(5000 + lab.seed))
    learnt = {"another pad's": lab.learnt}
    for n in PRESSES if lab.args.preset == "paper" else PRESSES[:1]:
        key_press, key_teach = jax.random.split(jax.random.fold_in(key_fit, n))
        fitted = press_and_fit(key_press, other, n)
        learnt[f"{n} presses"] = lab.training(fitted, key_teach)
    learnt["the pad itself"] = lab.training(other, jax.random.fold_in(key_fit, 0))
    sites = sample_sites(key_pool, lab.surfaces, lab.names, lab.cfg.num_sites, lab.cfg.site_limits)
    places = placements_of(lab)
    tables = imagine(lab, sites, places, [each.reading_model for each in learnt.values()], "new pad")
    truth = np.repeat(np.arange(len(lab.surfaces)), lab.sittings)
    chosen = draw_random_sites(key_site, sites, len(truth), lab.cfg.touches)
    episodes = sit(lab, key_play, sites, truth, chosen, "new pad", pad=other)
    found: dict[str, Any] = {"truth": truth}
    for (name, each), table in zip(learnt.items(), tables, strict=True):
        told = run_belief(table, episodes, each.likelihood, places, ("fused", "tactile only"))
        found |= {f"{kind}, {name}": p for kind, p in told.items()}
    return found | run_belief(tables[0], episodes, lab.learnt.likelihood, places, ("position only",))


def press_and_fit(key: Array, pad: Pad, n: int) -> Pad:
    """Press a pad n times with a known ball, and fit one to what it reads (`i2t.calibration.physics`)."""
    key_place, key_force, key_noise, key_wrench = jax.random.split(key, 4)
    place = jax.random.uniform(key_place, (n, 2), minval=-8e-3, maxval=8e-3)
    force = jax.random.uniform(key_force, (n,), minval=0.2, maxval=1.0)
    clean = jax.lax.map(lambda at: press_force(pad, BALL.height(at[0], GRID), at[1]).reading, (place, force))
    readings = jax.vmap(lambda k, r: add_sensor_noise(k, r, pad.board, Noise()))(jax.random.split(key_noise, n), clean)
    presses = Presses(place, force + 0.02 * jax.random.normal(key_wrench, (n,)))
    return fit_pad(presses, readings, tip=BALL, board=reskin_board(), by_force=True).pad
