"""Plans of simulated episodes: sets of objects, where they are touched, and how long that takes."""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from experiments.recognize.config import Recognition
from experiments.recognize.trained_run import load_meshes, meshes_by_name
from i2t.objects import Mesh
from i2t.recognition.belief import Particles
from i2t.recognition.episodes import BeliefModel
from i2t.recognition.local_surfaces import is_large, reached_boxes
from i2t.recognition.site_pool import (
    BATCH_TOUCHES,
    TouchPlan,
    plan_informative_touches,
    plan_random_touches,
    predict_outcomes,
    sample_pools,
)
from i2t.types import Surface


class ObjectSet(NamedTuple):
    """A set of objects to tell apart."""

    names: Sequence[str]
    episodes: int  # of each
    heuristic: bool  # whether the paper's chooses the sites
    share: int = 1  # episodes that touch the same sites, each of which is then imagined once for all of them


def object_groups(
    objects: Sequence[Path], unit: str | None, cfg: Recognition
) -> list[tuple[dict[str, Mesh], dict[str, ObjectSet]]]:
    """Groups of meshes by name, each with the sets that are played among them."""
    if objects:
        own = load_meshes(objects, unit)
        return [(own, {"your objects": ObjectSet(list(own), cfg.own_episodes, False, cfg.pool_episodes)})]
    return [
        (
            meshes_by_name(cfg.validation),
            {"validation": ObjectSet(cfg.validation, cfg.validation_episodes, False)},
        ),
        (
            meshes_by_name(cfg.objects),
            {
                "all": ObjectSet(cfg.objects, cfg.episodes, False),
                "primitives": ObjectSet(cfg.primitives, cfg.paper_episodes, True),
                "tools": ObjectSet(cfg.tools, cfg.paper_episodes, True),
            },
        ),
    ]


def how_long(
    name: str,
    surfaces: Sequence[Surface],
    plan: TouchPlan,
    models: Mapping[str, BeliefModel],
    *,
    particles: Particles,
    overtravel: float,
) -> str:
    """Estimate the time to imagine all touches of a set from a first batch, which is compiled before."""
    T, twist = np.asarray(plan.sites.T_w_t), particles.twist
    boxes = reached_boxes(surfaces[:1], twist) if is_large(surfaces) else None
    some = T[: max(BATCH_TOUCHES // len(twist), 1)]
    reading_models = [model.reading_model for model in models.values()]
    imagine = partial(predict_outcomes, surfaces[:1], twist, some, reading_models, overtravel=overtravel, boxes=boxes)
    imagine()
    started = time.perf_counter()
    imagine()
    count, batch = len(surfaces) * len(T) * len(twist), len(some) * len(twist)
    minutes = (time.perf_counter() - started) * count / batch / 60
    return (
        f"{name}: {plan.chosen.size:,} touches are simulated, and {count:,} imagined in some {max(minutes, 1):.0f} min "
        f"on this machine (measured on {batch}); fewer --episodes or --num-particles take less"
    )


def plan_touches(
    key: jax.Array, objects: ObjectSet, surfaces: Sequence[Surface], episodes: int, cfg: Recognition
) -> TouchPlan:
    """Plan the sites of episodes: the heuristic's, of random candidates, or random ones."""
    if not objects.heuristic:
        return plan_random_touches(
            key, surfaces, objects.names, episodes, cfg.touches, limits=cfg.site_limits, share=objects.share
        )
    key_pools, key_sites = jax.random.split(key)
    pool = np.arange(episodes) // cfg.pool_episodes
    pools = sample_pools(
        key_pools, surfaces, objects.names, pools=int(pool[-1]) + 1, each=cfg.pool_sites, limits=cfg.site_limits
    )
    return plan_informative_touches(key_sites, pools, pool, cfg.touches)
