"""A skin of a physics that nobody modelled, to which a pad model is fitted by its own touches.

Every physics is left out once: how far its readings count (an inflation of their errors, and the temperature of the
belief) is learnt from episodes with validation objects in all others, and judged on test objects in this one. Pad
models are fitted to a few touches of the training objects made in that physics, or to as many as the run had.
"""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from experiments.common.runs import Part
from experiments.studies import free_sides
from experiments.studies.lab import StudyLab, StudyWorld
from experiments.studies.settings import REMOUNTED_M, faulty
from experiments.studies.winkler import winkler_press
from i2t.recognition.episodes import run_belief
from i2t.recognition.pad_model import PadModel, inflated
from i2t.types import Board

TOUCHES = (20, 200, None)  # of the skin that a pad model is fitted to; None: as many as the run had
DEBUG_TOUCHES = (20, None)
INFLATIONS = (0.7, 1.0, 1.4, 2.0, 2.8)  # of the errors of readings, to choose from
WITHOUT = "position and presence"  # the evidence of a belief without readings
KINDS = ("fused", "readings")
MATCHED = "bonded layer"
SETS = ("validation", "test")


def worlds(lab: StudyLab) -> dict[str, StudyWorld]:
    """Physics by name; the first is that of the pad models' layer."""
    pad, errors = lab.run.pad, lab.cfg.errors
    chips = jnp.asarray(pad.board.chips) + jnp.asarray(REMOUNTED_M, jnp.float32)[None]
    worn = pad._replace(young=0.7 * pad.young, magnetization=0.9 * pad.magnetization)
    found = {
        MATCHED: StudyWorld(),
        "Winkler foundation": StudyWorld(law=lambda _: winkler_press),
        "free side faces": StudyWorld(law=free_sides.press_law),
        "soft compressible layer": StudyWorld(pad=pad._replace(young=0.6 * pad.young, poisson=jnp.float32(0.3))),
        "worn pad": StudyWorld(pad=worn, errors=faulty(errors, relaxation=0.15)),
        "skin remounted by 0.5 mm": StudyWorld(pad=pad._replace(board=Board(chips, pad.board.rotations))),
    }
    return dict(list(found.items())[:2]) if lab.args.debug else found


def evaluate(lab: StudyLab) -> Part:
    """Beliefs (e, t, objects) by "set, physics, touches, inflation, evidence", and the truth of each set."""
    key_fit, *keys = jax.random.split(lab.key, 1 + len(SETS))
    made = worlds(lab)
    counts = DEBUG_TOUCHES if lab.args.debug else TOUCHES
    models = {
        (name, count): lab.refit(jax.random.fold_in(key_fit, i), made[name], count)
        for i, (name, count) in enumerate(product(made, counts))
    }
    found: Part = {"layers": np.array([[float(x) for x in one.reading_model.layer] for one in models.values()])}
    for name, key, objects in zip(SETS, keys, (lab.cfg.validation, lab.cfg.objects), strict=True):
        found[name] = _evaluate_set(lab.with_objects(objects), key, made, models, name)
    return found


def _evaluate_set(
    lab: StudyLab,
    key: Array,
    made: dict[str, StudyWorld],
    models: dict[tuple[str, int | None], PadModel],
    label: str,
) -> Part:
    key_sites, key_episodes = jax.random.split(key)
    truth, particles = lab.truth(), lab.particles()
    plan = lab.plan(key_sites, len(truth))
    tables = lab.predict(plan.sites, particles, [one.reading_model for one in models.values()], label)
    by_model = dict(zip(models, tables, strict=True))
    found: Part = {"truth": truth, "pool": plan.pool}
    for name, world in made.items():
        episodes = lab.simulate(jax.random.clone(key_episodes), plan, truth, f"{label}, {name}", world=world)
        for (where, count), model in models.items():
            if where != name:
                continue
            table = by_model[where, count]
            without = run_belief(table, episodes, model.likelihood, particles, [WITHOUT])
            found[f"{name}/{count}/1/{WITHOUT}"] = without[WITHOUT]
            for factor in INFLATIONS:
                beliefs = run_belief(table, episodes, inflated(model, factor).likelihood, particles, KINDS)
                found |= {f"{name}/{count}/{factor:g}/{kind}": p for kind, p in beliefs.items()}
    return found
