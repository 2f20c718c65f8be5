"""Number of presses that a pad needs that was never recorded. It is pressed with a known ball, and a pad is fitted to
its readings (`i2t.calibration.physics`). As in `experiments.recognize --pad`, a pad model is fitted to simulated
touches with that pad, and errs as much more as the pad is off presses left out.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.common.runs import Part
from experiments.studies.lab import StudyLab
from i2t.calibration.physics import PadFit, RoundTip, fit_pad
from i2t.calibration.structured_gp import Presses
from i2t.recognition.episodes import run_belief
from i2t.recognition.pad_model import PadModel, with_press_errors
from i2t.skin.contact import GRID
from i2t.skin.noise import Noise, add_sensor_noise
from i2t.skin.pad import press_force, sample_pad
from i2t.types import Board, Pad

PRESS_COUNTS = (5, 20, 100)
BALL = RoundTip("sphere", 4e-3)
FIRST_NEW_PAD_SEED = 5000  # of the pads that were never recorded, apart from those of the runs
PRESS_HALF_WIDTH_M = 8e-3
PRESS_FORCES_N = (0.2, 1.0)
FORCE_NOISE_N = 0.02


def evaluate(lab: StudyLab) -> Part:
    """The same episodes with a pad that was never recorded, by pad models that know it better and better."""
    key_sites, key_episodes, key_fit = jax.random.split(lab.key, 3)
    pad = sample_pad(jax.random.key(FIRST_NEW_PAD_SEED + lab.seed), board=lab.run.dataset.board)
    models = fit_models(lab, key_fit, pad)
    plan, particles = lab.plan(key_sites), lab.particles()
    tables = lab.predict(plan.sites, particles, [model.reading_model for model in models.values()], "new pad")
    episodes = lab.simulate(key_episodes, plan, "new pad", pad=pad)
    found: dict[str, np.ndarray] = {"truth": plan.truth, "pool": plan.pool}
    for (name, model), table in zip(models.items(), tables, strict=True):
        beliefs = run_belief(table, episodes, model.likelihood, particles, ("fused", "readings and presence"))
        found |= {f"{kind}, {name}": p for kind, p in beliefs.items()}
    return found | run_belief(tables[0], episodes, lab.pad_model.likelihood, particles, ("position and presence",))


def fit_models(lab: StudyLab, key: Array, pad: Pad) -> dict[str, PadModel]:
    """Pad models by name: another pad's, those of pads fitted to some presses, and that of the pad itself."""
    models = {"another pad's": lab.pad_model}
    for n in PRESS_COUNTS[:1] if lab.args.debug else PRESS_COUNTS:
        key_press, key_model = jax.random.split(jax.random.fold_in(key, n))
        fitted = press_and_fit(key_press, pad, n, lab.run.dataset.board)
        error_std = float(jnp.sqrt(jnp.mean(fitted.leave_one_out**2)))
        models[f"{n} presses"] = with_press_errors(lab.refit(key_model, pad=fitted.pad), error_std)
    models["the pad itself"] = lab.refit(jax.random.fold_in(key, 0), pad=pad)
    return models


def press_and_fit(key: Array, pad: Pad, n: int, board: Board) -> PadFit:
    """Press a pad n times with a known ball, and fit one to its readings; `board` is its nominal one."""
    key_position, key_force, key_noise, key_wrench = jax.random.split(key, 4)
    position = jax.random.uniform(key_position, (n, 2), minval=-PRESS_HALF_WIDTH_M, maxval=PRESS_HALF_WIDTH_M)
    force = jax.random.uniform(key_force, (n,), minval=PRESS_FORCES_N[0], maxval=PRESS_FORCES_N[1])
    clean = jax.lax.map(lambda at: press_force(pad, BALL.height(at[0], GRID), at[1]).reading, (position, force))
    readings = jax.vmap(lambda k, r: add_sensor_noise(k, r, pad.board, Noise()))(jax.random.split(key_noise, n), clean)
    presses = Presses(position, force + FORCE_NOISE_N * jax.random.normal(key_wrench, (n,)))
    return fit_pad(presses, readings, tip=BALL, board=board, by_force=True)
