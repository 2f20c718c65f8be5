"""What errors of pose, noise and harder presses do: the same sittings in other worlds, each known to the belief."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.studies.lab import Lab, imagine, placements_of, sit
from i2t.recognition import belief, outcomes
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import Episodes, run_belief
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.site_pool import draw_random_sites, sample_sites
from i2t.simulation.touches import SimulationErrors

HARDER = (50.0, 100.0)  # uT at which presses stop that the pad is taught by, too


def play(lab: Lab) -> dict[str, Any]:
    """The same sittings in other worlds, each known to the belief."""
    base, debug = lab.cfg.errors, lab.args.preset == "debug"
    worlds: dict[str, tuple[SimulationErrors, float]] = {
        "as it is": (base, 25.0),
        "placement 0.3 mm, 0.3 deg": (replace(base, placement=0.3e-3, placement_angle=np.radians(0.3)), 25.0),
        "placement 2 mm, 2 deg": (replace(base, placement=2e-3, placement_angle=np.radians(2.0)), 25.0),
        "tilt 1 deg": (replace(base, approach_angle=np.radians(1.0)), 25.0),
        "noise x 3": (replace(base, noise=base.noise.scaled(3.0)), 25.0),
        "stop at 50 uT": (base, 50.0),
        "stop at 100 uT": (base, 100.0),
        "no errors of pose": (base.scaled(0.0), 25.0),
        "no noise, no faults": (replace(SimulationErrors.none(), placement=base.placement, placement_angle=base.placement_angle,
                                        repeatability=base.repeatability, approach_angle=base.approach_angle,
                                        slant=base.slant), 25.0),
    }  # fmt: skip
    if debug:
        worlds = {name: worlds[name] for name in ("as it is", "stop at 50 uT")}
    key_pool, key_play, key_site, key_press = jax.random.split(lab.key, 4)
    sites = sample_sites(key_pool, lab.surfaces, lab.names, lab.cfg.num_sites, lab.cfg.site_limits)
    truth = np.repeat(np.arange(len(lab.surfaces)), lab.sittings)
    chosen = draw_random_sites(key_site, sites, len(truth), lab.cfg.touches)
    tables: dict[tuple[float, float], tuple[Particles, PredictedTouch]] = {}
    played: dict[float, Episodes] = {}
    found: dict[str, Any] = {"truth": truth}
    for name, (errors, stop) in worlds.items():
        spread = (max(errors.placement, 0.02e-3), max(errors.placement_angle, np.radians(0.02)))
        if spread not in tables:
            places = belief.sample_particles(outcomes.placement_std(*spread), lab.cfg.num_particles, lab.seed)
            tables[spread] = (places, imagine(lab, sites, places, [lab.learnt.reading_model], name)[0])
        places, table = tables[spread]
        limits, key = replace(lab.cfg.limits, skin_change=stop), jax.random.clone(key_play)  # the same luck in all
        episodes = played[stop] = sit(lab, key, sites, truth, chosen, name, errors=errors, limits=limits)
        wider = errors.noise.xy / base.noise.xy if errors.noise.xy > base.noise.xy else 1.0
        like = lab.learnt.likelihood._replace(inflation=lab.learnt.likelihood.inflation * jnp.float32(wider))
        told = run_belief(table, episodes, like, places, ("fused", "tactile only"))
        found |= {f"{kind}, {name}": p for kind, p in told.items()}

    places = placements_of(lab)
    for stop in (stop for stop in HARDER if stop in played):
        limits, name = replace(lab.cfg.limits, skin_change=stop), f"stop at {stop:.0f} uT, taught there"
        learnt = lab.pressed(limits, jax.random.fold_in(key_press, int(stop)))
        (table,) = imagine(lab, sites, places, [learnt.reading_model], name)
        told = run_belief(table, played[stop], learnt.likelihood, places, ("fused", "tactile only"))
        found |= {f"{kind}, {name}": p for kind, p in told.items()}
    return found
