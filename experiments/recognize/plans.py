"""Plans of episodes: sets of objects to distinguish, and the sites of touches."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from experiments.recognize.config import Recognition
from i2t.objects import Mesh
from i2t.objects.named import read_meshes
from i2t.recognition.site_pool import SitePools, TouchPlan, plan_informative_touches, plan_random_touches, sample_pools
from i2t.types import Surface


class ObjectSet(NamedTuple):
    """A set of objects to distinguish."""

    names: Sequence[str]
    episodes: int  # of each object
    heuristic: bool  # whether the paper's heuristic chooses the sites
    share: int = 1  # episodes with the same sites, for which predictions are computed once


def object_groups(own: Mapping[str, Mesh], cfg: Recognition) -> list[tuple[Mapping[str, Mesh], dict[str, ObjectSet]]]:
    """Group the user's own objects, or the preset's, into meshes by name and the sets that share them."""
    if own:
        return [(own, {"your objects": ObjectSet(list(own), cfg.own_episodes, False, cfg.pool_episodes)})]
    return [
        (
            read_meshes(cfg.validation),
            {"validation": ObjectSet(cfg.validation, cfg.validation_episodes, False)},
        ),
        (
            read_meshes(cfg.objects),
            {
                "all": ObjectSet(cfg.objects, cfg.episodes, False),
                "primitives": ObjectSet(cfg.primitives, cfg.paper_episodes, True),
                "tools": ObjectSet(cfg.tools, cfg.paper_episodes, True),
            },
        ),
    ]


def plan_touches(
    key: jax.Array, objects: ObjectSet, surfaces: Sequence[Surface], episodes: int, cfg: Recognition
) -> TouchPlan:
    """Plan the sites of episodes by the paper's heuristic on random candidates, or at random."""
    if not objects.heuristic:
        return plan_random_touches(
            key, surfaces, objects.names, episodes, cfg.touches, limits=cfg.site_limits, share=objects.share
        )
    key_pools, key_sites = jax.random.split(key)
    pools, pool = draw_pools(key_pools, objects.names, surfaces, episodes, cfg)
    return plan_informative_touches(key_sites, pools, pool, cfg.touches)


def draw_pools(
    key: jax.Array, names: Sequence[str], surfaces: Sequence[Surface], episodes: int, cfg: Recognition
) -> tuple[SitePools, np.ndarray]:
    """Draw pools of random sites, each for a few episodes. Returns them with the number (e,) of each episode's pool."""
    pool = np.arange(episodes) // cfg.pool_episodes
    count = int(pool[-1]) + 1
    pools = sample_pools(key, surfaces, names, pools=count, per_object=cfg.pool_sites, limits=cfg.site_limits)
    return pools, pool
