"""Environments made of objects and pads, and their touches made once, so that a step is a look-up.

`make_environment` draws sites and pads; `tabulate` presses every pad on every object in a number of placements at every
site, with the errors of the arm; noise of force sensor and chips is drawn at each step. Who touches a site twice in an
episode meets the same error of the arm twice.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from i2t.environments.core import (
    EnvironmentConfig,
    EnvironmentParams,
    OutcomeTable,
    TouchEnvironment,
    sample_placement,
)
from i2t.environments.press import TouchOutcome, response_map, touch_outcome
from i2t.objects.catalogue import make_object
from i2t.objects.solids import Mesh
from i2t.recognition.site_pool import SitePool, prepare_surfaces, safe_sites, sample_sites
from i2t.rendering.ops import element
from i2t.rendering.render import stack_surfaces
from i2t.runtime.batching import map_batches
from i2t.runtime.compiling import jit_quickly
from i2t.skin.pad import numbered_pad
from i2t.types import Board, Pad, Surface

SAFE_CANDIDATES_PER_SITE = 4  # drawn for each that is wanted: it has to be safe on every object
TABULATED_BATCH = 32  # approaches at a time, each pressed with every pad


def make_environment(
    objects: Sequence[str | Mesh],
    *,
    config: EnvironmentConfig | None = None,
    sites: int = 48,
    pads: int = 8,
    first_pad: int = 0,
    board: Board | None = None,
    seed: int = 0,
) -> tuple[TouchEnvironment, EnvironmentParams]:
    """An environment with exact physics.

    Args:
        objects: names of the catalogue, or meshes (m) that stand on z = 0.
        config: its rules.
        sites: how many there are, drawn from all objects alike, each safe on every object.
        pads: how many there are.
        first_pad: number of the first (`i2t.skin.pad.numbered_pad`); others number others.
        board: whose chips lie below the skins; ReSkin's five by default.
        seed: of the sites.

    Returns:
        The environment and its parameters.

    Raises:
        ValueError: too few objects, sites or pads, or no site is safe on every object.

    Example:
        environment, params = make_environment(("star", "hexagon", "cylinder"))
    """
    config = config or EnvironmentConfig()
    if not objects or sites < 1 or pads < 1:
        raise ValueError(f"an environment of {len(objects)} objects, {sites} sites, {pads} pads; give one of each")
    names = [item if isinstance(item, str) else f"object {i}" for i, item in enumerate(objects)]
    surfaces = prepare_surfaces([make_object(item).mesh if isinstance(item, str) else item for item in objects])
    pool = _safe_sites(jax.random.key(seed), surfaces, names, count=sites, config=config)
    skins = jax.tree.map(
        lambda *x: jnp.asarray(np.stack(x)), *(numbered_pad(first_pad + i, board=board) for i in range(pads))
    )
    params = EnvironmentParams(
        surfaces=jax.tree.map(jnp.asarray, stack_surfaces(surfaces)),
        pads=skins,
        response=_response_maps(skins),
        T_w_site=jnp.asarray(pool.T_w_t),
        owner=jnp.asarray(pool.owner),
        allowed=jnp.ones(len(pool.owner), bool),
    )
    return TouchEnvironment(config), params


def tabulate(
    key: Key[Array, ""], environment: TouchEnvironment, params: EnvironmentParams, placements: int = 32
) -> EnvironmentParams:
    """Make every touch once: of every object in some placements at every site with every pad.

    Args:
        key: random key of placements and of the arm's errors.
        environment: whose errors and limits hold.
        params: what may be there.
        placements: drawn once, the same for every object.

    Returns:
        The parameters with their table; steps are look-ups from here on.
    """
    config = environment.config
    key_place, key_touch = jax.random.split(key)
    T_w_o = jax.vmap(lambda k: sample_placement(k, config.errors))(jax.random.split(key_place, placements))
    columns = []
    for i in range(params.objects):
        keys = jax.random.split(jax.random.fold_in(key_touch, i), placements * params.sites)
        columns.append(jax.device_get(_touch_all(keys, element(params.surfaces, i), T_w_o, params, config)))
    stacked = jax.tree.map(lambda *x: jnp.asarray(np.stack(x, axis=1)), *columns)
    return params._replace(table=OutcomeTable(stacked, T_w_o))


@jit_quickly
def _response_maps(pads: Pad) -> Array:
    return jax.lax.map(response_map, pads)


@jax.jit
def _touch_all(
    keys: Array, surface: Surface, T_w_o: Array, params: EnvironmentParams, config: EnvironmentConfig
) -> TouchOutcome:
    """Touches of one object, (pads, placements, sites)."""
    placements, sites = T_w_o.shape[0], params.sites
    row, site = jnp.divmod(jnp.arange(placements * sites), sites)

    def one(at: tuple[Array, Array, Array]) -> TouchOutcome:
        key, row, site = at
        return touch_outcome(
            key, surface, T_w_o[row], params.T_w_site[site],
            pads=params.pads, response=params.response, errors=config.errors, limits=config.limits,
        )  # fmt: skip

    made = map_batches(one, (keys, row, site), batch_size=TABULATED_BATCH)
    return jax.tree.map(lambda x: jnp.moveaxis(x.reshape(placements, sites, *x.shape[1:]), 2, 0), made)


def _safe_sites(
    key: Array, surfaces: list[Surface], names: Sequence[str], *, count: int, config: EnvironmentConfig
) -> SitePool:
    """Sites that are safe on every object where it is believed to stand, of each as many as there can be."""
    each = -(-count // len(surfaces))
    pool = sample_sites(key, surfaces, names, SAFE_CANDIDATES_PER_SITE * each, config.safety)
    safe = np.all(safe_sites(surfaces, pool, config.safety), axis=1)
    good = np.flatnonzero(safe)
    if len(good) < count:
        raise ValueError(
            f"{len(good)} of {len(pool.owner)} sites are safe on every object, and {count} are wanted; ask for fewer "
            "sites, or for objects of one height"
        )
    # Interleaved: the first of each object, then the second, until there are enough.
    rank = np.array([np.sum(pool.owner[good][:i] == owner) for i, owner in enumerate(pool.owner[good])])
    chosen = np.sort(good[np.lexsort((pool.owner[good], rank))[:count]])
    return SitePool(pool.T_w_t[chosen], pool.owner[chosen])
