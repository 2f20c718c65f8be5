"""Effect of errors of pose, noise and harder presses: the same episodes in other worlds, each known to the belief."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common.runs import Part
from experiments.studies.lab import EpisodePlan, StudyLab
from i2t.recognition import belief, outcomes
from i2t.recognition.belief import Likelihood
from i2t.recognition.episodes import Episodes, run_belief
from i2t.simulation.touches import SimulationErrors

KINDS = ("fused", "readings and presence")
SKIN_CHANGE_UT = 25.0  # at which presses stop, unless a world says otherwise
REFITTED_UT = (50.0, 100.0)  # at which presses stop that a pad model is fitted to, too
AMBIENT_EVERY = (5, 20)  # touches; an episode of ten has one in its first touch at 20
FOLLOWED_DRIFT_UT = 20.0  # of the order of the earth's field (48 uT) on one axis while the tool turns between touches
MIN_PLACEMENT_M, MIN_PLACEMENT_RAD = 0.02e-3, np.radians(0.02)  # spread of pose particles where poses are exact


class SensitivityWorld(NamedTuple):
    """Errors of a world, and the change of the readings at which presses stop."""

    errors: SimulationErrors
    skin_change: float = SKIN_CHANGE_UT  # uT
    drift_std: float = 0.0  # uT from touch to touch, of the bias that the belief follows


def worlds(base: SimulationErrors) -> dict[str, SensitivityWorld]:
    """The worlds by name; the first is the usual one."""
    without = replace(
        SimulationErrors.none(), placement=base.placement, placement_angle=base.placement_angle,
        repeatability=base.repeatability, approach_angle=base.approach_angle, slant=base.slant,
    )  # fmt: skip
    return {
        "default": SensitivityWorld(base),
        "placement 0.3 mm, 0.3 deg": SensitivityWorld(_placed(base, 0.3)),
        "placement 2 mm, 2 deg": SensitivityWorld(_placed(base, 2.0)),
        "tilt 1 deg": SensitivityWorld(replace(base, approach_angle=np.radians(1.0))),
        "noise x 3": SensitivityWorld(replace(base, noise=base.noise.scaled(3.0))),
        "stop at 50 uT": SensitivityWorld(base, 50.0),
        "stop at 100 uT": SensitivityWorld(base, 100.0),
        **{f"ambient every {each} touches": SensitivityWorld(_ambient_every(base, each)) for each in AMBIENT_EVERY},
        **{
            f"ambient every {each} touches, drift followed": SensitivityWorld(
                _ambient_every(base, each), drift_std=FOLLOWED_DRIFT_UT
            )
            for each in AMBIENT_EVERY
        },
        "no errors of pose": SensitivityWorld(base.scaled(0.0)),
        "no noise, no faults": SensitivityWorld(without),
    }


def _ambient_every(base: SimulationErrors, touches: int) -> SimulationErrors:
    """Errors with the ambient measured at every so many touches: the earth's field turns with the tool in between."""
    return replace(base, faults=replace(base.faults, ambient_every=touches))


def _placed(base: SimulationErrors, size: float) -> SimulationErrors:
    """Errors with another one of placement, in mm and degrees."""
    return replace(base, placement=size * 1e-3, placement_angle=np.radians(size))


def evaluate(lab: StudyLab) -> Part:
    """Beliefs in episodes with common random numbers in every world, each known to the belief."""
    some = worlds(lab.cfg.errors)
    if lab.args.debug:
        some = {name: some[name] for name in ("default", "stop at 50 uT")}
    key_sites, key_episodes, key_press = jax.random.split(lab.key, 3)
    plan = lab.plan(key_sites)
    found: dict[str, np.ndarray] = {"truth": plan.truth, "pool": plan.pool}
    played: dict[tuple[SimulationErrors, float], Episodes] = {}
    tables: dict[tuple[float, float], tuple[belief.Particles, outcomes.PredictedTouch]] = {}
    for name, world in some.items():
        errors = world.errors
        spread = (max(errors.placement, MIN_PLACEMENT_M), max(errors.placement_angle, MIN_PLACEMENT_RAD))
        if spread not in tables:
            particles = belief.sample_particles(outcomes.placement_std(*spread), lab.cfg.num_particles, lab.seed)
            tables[spread] = (particles, lab.predict(plan.sites, particles, [lab.pad_model.reading_model], name)[0])
        particles, table = tables[spread]
        same = errors, world.skin_change
        if same not in played:
            limits = replace(lab.cfg.limits, skin_change=world.skin_change)
            played[same] = lab.simulate(jax.random.clone(key_episodes), plan, name, errors=errors, limits=limits)
        likelihood = noisier_likelihood(lab, errors)
        likelihood = likelihood._replace(drift_std=jnp.float32(world.drift_std))
        beliefs = run_belief(table, played[same], likelihood, particles, KINDS)
        found |= {f"{kind}, {name}": p for kind, p in beliefs.items()}
    harder = {stop: played[lab.cfg.errors, stop] for stop in REFITTED_UT if (lab.cfg.errors, stop) in played}
    return found | evaluate_refitted(lab, key_press, plan, harder)


def noisier_likelihood(lab: StudyLab, errors: SimulationErrors) -> Likelihood:
    """The likelihood of the pad model, wider where the noise is more than that of the touches it was fitted to."""
    likelihood = lab.pad_model.likelihood
    wider = max(errors.noise.xy / lab.cfg.errors.noise.xy, 1.0)
    return likelihood._replace(inflation=likelihood.inflation * jnp.float32(wider))


def evaluate_refitted(
    lab: StudyLab, key: jax.Array, plan: EpisodePlan, harder: dict[float, Episodes]
) -> dict[str, np.ndarray]:
    """Beliefs in the episodes of harder presses with a pad model fitted to presses as hard."""
    found: dict[str, np.ndarray] = {}
    particles = lab.particles()
    for stop, episodes in harder.items():
        name = f"stop at {stop:.0f} uT, fitted there"
        model = lab.refit(jax.random.fold_in(key, int(stop)), limits=replace(lab.cfg.limits, skin_change=stop))
        (table,) = lab.predict(plan.sites, particles, [model.reading_model], name)
        beliefs = run_belief(table, episodes, model.likelihood, particles, KINDS)
        found |= {f"{kind}, {name}": p for kind, p in beliefs.items()}
    return found
