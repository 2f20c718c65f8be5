"""Candidate sites of several objects, and what a touch of each would be like on every object.

Sites come from a pool, so that touches of them are predicted once, for every object in each of its possible poses
(`precompute_outcomes`), and serve all episodes. Objects stand at the world's origin; where a pool is used on a real
object, its poses are T_o_site.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key
from tqdm import tqdm

from i2t.recognition import belief, ensemble, outcomes
from i2t.recognition.belief import Particles
from i2t.recognition.outcomes import LinearReadingModel, PredictedTouch
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, stack_surfaces
from i2t.simulation import sites as touch_sites
from i2t.simulation.touches import SimulationErrors
from i2t.types import Surface

BATCH_TOUCHES = 512  # predicted at a time


class SitePool(NamedTuple):
    """Safe sites of all objects, as many of each."""

    T_w_t: Float[Array, "sites 4 4"]  # tool poses where the skin would just lie on the surface
    owner: Int[np.ndarray, " sites"]  # index of the object on which the site was drawn


def prepare_surfaces(meshes: Sequence[Any]) -> list[Surface]:
    """Surfaces of one size class, so that one compilation serves all.

    Args:
        meshes: Of the objects.

    Returns:
        Prepared surfaces.
    """
    stacked = stack_surfaces([prepare_surface(mesh) for mesh in meshes])
    return [element(stacked, i) for i in range(len(meshes))]


def pose_particles(errors: SimulationErrors, count: int, seed: int) -> Particles:
    """Poses in which an object may stand.

    Args:
        errors: Those of placement count.
        count: Number of particles.
        seed: Of the quasi-random sequence.

    Returns:
        The particles.
    """
    return belief.sample_particles(outcomes.placement_std(errors.placement, errors.placement_angle), count, seed)


def sample_sites(
    key: Key[Array, ""], surfaces: Sequence[Surface], names: Sequence[str], each: int, limits: touch_sites.SiteLimits
) -> SitePool:
    """Draw random safe sites of every object, all objects standing at the world's origin.

    Args:
        key: Of the sites.
        surfaces: Of the objects.
        names: Of the objects, for messages.
        each: How many sites of each object.
        limits: What makes a site safe.

    Returns:
        The sites, ordered by object.

    Raises:
        ValueError: An object has too few safe sites.
    """
    found = [
        touch_sites.collect_sites(jax.random.fold_in(key, i), surface, each, limits, name)
        for i, (surface, name) in enumerate(zip(surfaces, names, strict=True))
    ]
    return SitePool(jnp.concatenate(found), np.repeat(np.arange(len(surfaces)), each))


def safe_sites(
    surfaces: Sequence[Surface], sites: SitePool, limits: touch_sites.SiteLimits
) -> Bool[np.ndarray, "sites objects"]:
    """Whether each site of a pool would be safe on each object; on its own object each is.

    Args:
        surfaces: Of the objects.
        sites: The pool.
        limits: What makes a site safe.

    Returns:
        Whether the site is safe, by site and object.
    """
    check = jax.jit(jax.vmap(partial(touch_sites.is_safe, limits=limits), (None, 0)))
    return np.stack([np.asarray(check(surface, sites.T_w_t)) for surface in surfaces], axis=1)


def precompute_outcomes(
    surfaces: Sequence[Surface],
    twist: Float[Array, "k 6"],
    T_w_site: Float[Array, "sites 4 4"],
    reading_models: Sequence[LinearReadingModel],
    *,
    overtravel: float,
    label: str,
) -> list[PredictedTouch]:
    """Predict a touch of every object in every pose at every site, with a progress bar.

    Args:
        surfaces: Of the objects.
        twist: Of the pose particles (m).
        T_w_site: Sites.
        reading_models: Of some pads, at the same loads.
        overtravel: Distance (m) beyond a site after which a press gives up.
        label: What the bar says the touches are for.

    Returns:
        For each pad the predicted touches, (sites, objects, k), on the host.
    """
    count = len(twist)
    each = max(BATCH_TOUCHES // count, 1)
    padded = jnp.asarray(np.resize(np.asarray(T_w_site), (-(-len(T_w_site) // each) * each, 4, 4)))
    columns = []
    total = len(surfaces) * len(padded) * count
    with tqdm(total=total, desc=f"{label}: imagining", unit="touch", unit_scale=True) as bar:
        for surface in surfaces:
            parts = []
            for start in range(0, len(padded), each):
                some = padded[start : start + each]
                parts.append(jax.device_get(_predict(surface, twist, some, list(reading_models), overtravel)))
                bar.update(each * count)
            columns.append(jax.tree.map(lambda *x: np.concatenate(x)[: len(T_w_site)], *parts))
    return jax.tree.map(lambda *x: np.stack(x, axis=1), *columns)


@partial(jax.jit, static_argnames=("overtravel",))
def _predict(
    surface: Surface, twist: Array, T_w_site: Array, reading_models: list[LinearReadingModel], overtravel: float
) -> list[PredictedTouch]:
    def one(T: Array, x: Array) -> list[PredictedTouch]:
        contact = outcomes.predict_contact(surface, jnp.eye(4), x, T, reading_models[0].loads, overtravel=overtravel)
        return [outcomes.predict_reading(contact, model) for model in reading_models]

    return jax.vmap(lambda T: jax.vmap(lambda x: one(T, x))(twist))(T_w_site)


def draw_random_sites(key: Key[Array, ""], sites: SitePool, episodes: int, touches: int) -> Int[np.ndarray, "e t"]:
    """Random sites for each touch of some episodes; the same sites serve every method.

    Args:
        key: Of the draws.
        sites: The pool.
        episodes: How many.
        touches: Of each episode.

    Returns:
        Indices of sites.
    """
    return np.asarray(jax.random.randint(key, (episodes, touches), 0, len(sites.owner)))


def draw_informative_sites(key: Key[Array, ""], sites: SitePool, episodes: int, touches: int) -> Int[np.ndarray, "e t"]:
    """As `draw_random_sites`, but the site of a random object is drawn by the paper's heuristic
    (`i2t.recognition.ensemble.site_informativeness`).

    Args:
        key: Of the draws.
        sites: The pool.
        episodes: How many.
        touches: Of each episode.

    Returns:
        Indices of sites.
    """
    weight = own_site_informativeness(sites)
    key_object, key_site = jax.random.split(key)
    which = jax.random.randint(key_object, (episodes, touches), 0, len(weight))
    return np.asarray(which * weight.shape[1] + jax.random.categorical(key_site, jnp.log(weight[which])))


def own_site_informativeness(sites: SitePool) -> Float[Array, "objects each"]:
    """The paper's heuristic on each object's own sites, all of which are safe.

    Args:
        sites: The pool.

    Returns:
        Probabilities of the sites of each object.
    """
    objects = int(sites.owner.max()) + 1
    T = sites.T_w_t.reshape(objects, -1, 4, 4)
    safe = jnp.ones(T.shape[:2], bool)
    return jax.vmap(lambda o: ensemble.site_informativeness(T[..., :3, 3], -T[..., :3, 2], safe, o))(
        jnp.arange(objects)
    )
