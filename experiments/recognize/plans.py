"""Plans of episodes: objects to tell apart, sets of them, and where they are touched."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from experiments.common.checks import require_objects
from experiments.recognize.config import Recognition
from i2t.objects import Mesh, catalogue
from i2t.objects.named import read_object
from i2t.recognition.site_pool import SitePools, TouchPlan, plan_informative_touches, plan_random_touches, sample_pools
from i2t.types import Surface


class ObjectSet(NamedTuple):
    """A set of objects to tell apart."""

    names: Sequence[str]
    episodes: int  # of each
    heuristic: bool  # whether the paper's chooses the sites
    share: int = 1  # episodes that touch the same sites, each of which is then imagined once for all of them


def load_meshes(paths: Sequence[Path], unit: str | None) -> dict[str, Mesh]:
    """Meshes of the catalogue and of files.

    Args:
        paths: Names of the catalogue or of mesh files, two at least; none where the option was left out.
        unit: Of the files' lengths.

    Returns:
        The meshes by the objects' names: the catalogue's, or the files' stems.

    Raises:
        ValueError: Neither a name nor a file, a file without a unit, two objects of one name, or a single object.
    """
    require_objects(paths, unit)
    return {path.stem: read_object(str(path), unit).mesh for path in paths}


def meshes_by_name(names: Sequence[str]) -> dict[str, Mesh]:
    """Meshes of the catalogue.

    Args:
        names: Of its objects.

    Returns:
        The meshes by name.
    """
    return {name: catalogue.make_object(name).mesh for name in names}


def object_groups(own: Mapping[str, Mesh], cfg: Recognition) -> list[tuple[Mapping[str, Mesh], dict[str, ObjectSet]]]:
    """Groups of meshes by name, each with the sets that are played among them: the user's own, or the preset's."""
    if own:
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


def plan_touches(
    key: jax.Array, objects: ObjectSet, surfaces: Sequence[Surface], episodes: int, cfg: Recognition
) -> TouchPlan:
    """Plan the sites of episodes: the heuristic's, of random candidates, or random ones."""
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
    """Pools of random sites for a few episodes each, and the number (e,) of each episode's pool."""
    pool = np.arange(episodes) // cfg.pool_episodes
    count = int(pool[-1]) + 1
    pools = sample_pools(key, surfaces, names, pools=count, per_object=cfg.pool_sites, limits=cfg.site_limits)
    return pools, pool
