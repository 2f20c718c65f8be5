"""Environments built from objects and pads, and tables of their touches, so that a step is a look-up.

`make_environment` draws sites and pads. `tabulate` presses every pad on every object in a number of placements at every
site, with the errors of arm and force sensor; those of the skin are drawn in each episode. An episode that touches a
site twice gets the same press twice.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from i2t.contact.press import PadResponse, pad_response
from i2t.geometry import random_motion
from i2t.objects.catalogue import make_object
from i2t.objects.solids import Mesh
from i2t.recognition.environment import (
    EnvironmentConfig,
    EnvironmentParams,
    OutcomeTable,
    TabulatedTouches,
    TouchEnvironment,
    advance_along_approach,
)
from i2t.recognition.site_pool import SitePool, prepare_surfaces, safe_sites, sample_sites
from i2t.rendering.ops import element
from i2t.rendering.render import stack_surfaces
from i2t.runtime.batching import map_batches
from i2t.runtime.compiling import jit_quickly
from i2t.simulation.touches import SessionErrors, simulate_touch
from i2t.skin.dipoles import linear_response
from i2t.skin.elasticity import CELL_GRID
from i2t.skin.pad import pad_from_seed
from i2t.types import Board, Pad, ReturnCode, Surface


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
    """Build an environment whose touches are simulated when they are made.

    Args:
        objects: Names of the catalogue, or meshes (m) that stand on z = 0.
        config: Rules of the environment; by default presses are linear in the pressure (`EnvironmentConfig.law` is
            None).
        sites: Number of sites, drawn from all objects equally, each safe on every object.
        pads: Number of pads.
        first_pad: Number of the first pad (`i2t.skin.pad.pad_from_seed`); the others follow it.
        board: Board below the skins; ReSkin's five chips by default.
        seed: Seed of the sites.

    Returns:
        Environment and its parameters.

    Raises:
        ValueError: There are too few objects, sites or pads, or too few sites are safe on every object.

    Example:
        environment, params = make_environment(("star", "hexagon", "cylinder"))
    """
    config = config or EnvironmentConfig(law=None)
    if not objects or sites < 1 or pads < 1:
        raise ValueError(
            f"an environment of {len(objects)} objects, {sites} sites, {pads} pads; give at least one of each"
        )
    names = [item if isinstance(item, str) else f"object {i}" for i, item in enumerate(objects)]
    surfaces = prepare_surfaces([make_object(item).mesh if isinstance(item, str) else item for item in objects])
    pool = _safe_sites(jax.random.key(seed), surfaces, names, count=sites, config=config)
    skins = [pad_from_seed(first_pad + i, board=board) for i in range(pads)]
    return TouchEnvironment(config), environment_params(surfaces, skins, pool, config)


def environment_params(
    surfaces: Sequence[Surface], pads: Sequence[Pad], sites: SitePool, config: EnvironmentConfig
) -> EnvironmentParams:
    """Build the parameters of an environment in which every site may be touched.

    Args:
        surfaces: Surfaces of the objects, all of one size class.
        pads: The pads.
        sites: Sites that are safe on every object.
        config: Rules of the environment.

    Returns:
        Parameters without table and beliefs.
    """
    stacked = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *pads)
    return EnvironmentParams(
        surfaces=jax.tree.map(jnp.asarray, stack_surfaces(surfaces)),
        pads=stacked,
        response=_responses(stacked, config),
        T_w_site=jnp.asarray(sites.T_w_t),
        owner=jnp.asarray(sites.owner),
        allowed=jnp.ones(len(sites.owner), bool),
    )


def tabulate(
    key: Key[Array, ""], environment: TouchEnvironment, params: EnvironmentParams, placements: int = 32
) -> EnvironmentParams:
    """Tabulate the touches of every object in some placements at every site with every pad.

    Args:
        key: Random key of placements and of the errors of arm and force sensor.
        environment: The rules, with their errors, limits and press law.
        params: The objects and pads of the environment.
        placements: Number of placements, drawn once, the same for every object.

    Returns:
        Parameters with their table, so that steps are look-ups.
    """
    config = environment.config
    key_place, key_touch = jax.random.split(key)
    place = partial(random_motion, distance=config.errors.placement, angle=config.errors.placement_angle)
    T_w_o = jax.vmap(place)(jax.random.split(key_place, placements))
    columns = []
    for i in range(params.objects):
        keys = jax.random.split(jax.random.fold_in(key_touch, i), placements * params.sites)
        columns.append(jax.device_get(_touch_all(keys, element(params.surfaces, i), T_w_o, params, config)))
    touches = jax.tree.map(lambda *x: jnp.asarray(np.stack(x, axis=1)), *columns)
    return params._replace(table=OutcomeTable(touches, T_w_o))


@jit_quickly
def _responses(pads: Pad, config: EnvironmentConfig) -> PadResponse:
    def respond(pad: Pad) -> PadResponse:
        if config.law is None:
            return PadResponse(linear_response(pad, CELL_GRID), None)
        return pad_response(pad, config.limits.final)

    return jax.lax.map(respond, pads)


@jax.jit
def _touch_all(
    keys: Array, surface: Surface, T_w_o: Array, params: EnvironmentParams, config: EnvironmentConfig
) -> TabulatedTouches:
    """Simulate the touches of one object, (pads, placements, sites)."""
    placements, sites = T_w_o.shape[0], params.sites
    row, site = jnp.divmod(jnp.arange(placements * sites), sites)

    def touch(at: tuple[Array, Array, Array]) -> TabulatedTouches:
        key, row, site = at
        T_w_site = params.T_w_site[site]

        def press(pad: Pad, response: PadResponse) -> TabulatedTouches:
            touched = simulate_touch(
                key, surface, jnp.eye(4), T_w_site,
                session=SessionErrors(T_w_o[row], jnp.eye(4)), pad=pad, errors=config.errors,
                limits=config.limits, law=config.law, response=response,
            )  # fmt: skip
            advance = advance_along_approach(T_w_site, touched.T_w_t)
            return TabulatedTouches(touched.reading, touched.force, advance, touched.code != ReturnCode.AIR)

        return jax.vmap(press)(params.pads, params.response)

    touches = map_batches(touch, (keys, row, site), batch_size=32)  # approaches at a time, each with every pad
    return jax.tree.map(lambda x: jnp.moveaxis(x.reshape(placements, sites, *x.shape[1:]), 2, 0), touches)


def _safe_sites(
    key: Array, surfaces: list[Surface], names: Sequence[str], *, count: int, config: EnvironmentConfig
) -> SitePool:
    """Draw sites that are safe on every object at its believed pose, as equally from all objects as possible."""
    per_object = -(-count // len(surfaces))
    pool = sample_sites(key, surfaces, names, 4 * per_object, config.safety)  # not all are safe on every object
    safe = np.all(safe_sites(surfaces, pool, config.safety), axis=1)
    good = np.flatnonzero(safe)
    if len(good) < count:
        raise ValueError(
            f"{len(good)} of {len(pool.owner)} sites are safe on every object, but {count} are needed; ask for fewer "
            "sites, or use objects of one height"
        )
    # The sites are interleaved: the first of each object, then the second, and so on.
    rank = np.array([np.sum(pool.owner[good][:i] == owner) for i, owner in enumerate(pool.owner[good])])
    chosen = np.sort(good[np.lexsort((pool.owner[good], rank))[:count]])
    return SitePool(pool.T_w_t[chosen], pool.owner[chosen])
