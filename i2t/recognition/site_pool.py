"""Sites of several objects: the safe ones, the chosen ones, and the predicted touch of each on every object.

A pool of sites serves a recogniser that chooses among them, so that touches are predicted once for every object in each
of its possible poses (`predict_outcomes`). Episodes that are to be judged need sites of their own, because those
that share sites are alike: `plan_random_touches` draws every touch's site anew; where sites are chosen, `sample_pools`
draws a pool for every few episodes. Simulated objects stand at the world's origin. Where an object stands elsewhere,
its surface is placed there (`place_surfaces`) before sites are drawn and checked, because what is safe depends on how
it stands: on what is up, and on where the table is.
"""

from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.paper import loop
from i2t.recognition import belief, outcomes
from i2t.recognition.belief import Particles
from i2t.recognition.outcomes import PredictedTouch
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, stack_surfaces
from i2t.runtime.batching import filled_batches, spread
from i2t.runtime.compiling import jit_quickly
from i2t.runtime.progress import Progress, progress
from i2t.simulation import sites as touch_sites
from i2t.simulation.touches import SimulationErrors
from i2t.skin_models.reading_model import LinearReadingModel
from i2t.types import Surface, in_one_line

BATCH_TOUCHES = 512  # predicted at a time
DRAWN_SITES = 256  # at a time
CANDIDATES_PER_SITE = 2  # drawn for each site that is wanted; about half of them are safe
MIN_SAFE_SHARE = 1 / 64  # of candidates: an object on which fewer are safe has too few sites


@in_one_line
class SitePool(NamedTuple):
    """Safe sites of some objects."""

    T_w_t: Float[Array, "sites 4 4"]  # tool poses where the skin would just lie on the surface
    owner: Int[np.ndarray, " sites"]  # index of the object on which the site was drawn

    def moved(self, T_a_w: Float[Array | np.ndarray, "4 4"]) -> "SitePool":
        """The same sites in another frame.

        Args:
            T_a_w: The motion from the sites' frame to the other.

        Returns:
            The sites, with poses T_a_t.
        """
        poses = np.asarray(T_a_w, float) @ np.asarray(self.T_w_t, float)
        return SitePool(jnp.asarray(poses, jnp.float32), self.owner)


class SitePools(NamedTuple):
    """Several pools, as many safe sites of each object in each."""

    T_w_t: Float[np.ndarray, "pools objects each 4 4"]

    def joined(self) -> SitePool:
        """All sites as one pool.

        Returns:
            The sites; site i of object o in pool p is row (p * objects + o) * each + i.
        """
        pools, objects, each = self.T_w_t.shape[:3]
        return SitePool(jnp.asarray(self.T_w_t.reshape(-1, 4, 4)), np.tile(np.repeat(np.arange(objects), each), pools))


class TouchPlan(NamedTuple):
    """Touch sites of some episodes, decided beforehand."""

    sites: SitePool
    chosen: Int[np.ndarray, "e t"]  # sites of the touches
    pool: Int[np.ndarray, " e"]  # number of the pool that an episode's sites come from: those of one pool are alike


def prepare_surfaces(meshes: Sequence[Any]) -> list[Surface]:
    """Surfaces of one size class, so that one compilation serves all.

    Args:
        meshes: Of the objects.

    Returns:
        Prepared surfaces.
    """
    stacked = stack_surfaces([prepare_surface(mesh) for mesh in meshes])
    return [element(stacked, i) for i in range(len(meshes))]


def place_surfaces(surfaces: Sequence[Surface], T_w_o: Float[Array | np.ndarray, "4 4"]) -> list[Surface]:
    """The surfaces of objects where they stand, for drawing and checking sites.

    Args:
        surfaces: Each in its object's frame.
        T_w_o: Where all of them stand.

    Returns:
        Surfaces in W, triangles alone: they are not for rendering.
    """
    rows = np.asarray(T_w_o, float)[:3]

    def place(surface: Surface) -> Surface:
        x, y, z = np.moveaxis(np.asarray(surface.triangles, float), -1, 0)
        # Written out, so that the corners of a face that shrinks to a point stay equal to the last digit.
        moved = np.stack([row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows], axis=-1)
        return Surface(jnp.asarray(moved, jnp.float32))

    return [place(surface) for surface in surfaces]


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
    """Draw random safe sites of every object.

    Args:
        key: Of the sites.
        surfaces: Of the objects, in the world: at its origin, or placed by `place_surfaces`.
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
    return SitePool(jnp.asarray(np.concatenate(found)), np.repeat(np.arange(len(surfaces)), each))


def safe_sites(
    surfaces: Sequence[Surface], sites: SitePool, limits: touch_sites.SiteLimits
) -> Bool[np.ndarray, "sites objects"]:
    """Test each site of a pool for safety on each object; on its own object a drawn site is safe.

    Args:
        surfaces: Of the objects, in the world: at its origin, or placed by `place_surfaces`.
        sites: The pool, in the world.
        limits: What makes a site safe.

    Returns:
        Whether the site is safe, by site and object.
    """
    return np.stack([np.asarray(_are_safe(surface, sites.T_w_t, limits)) for surface in surfaces], axis=1)


@jit_quickly
def _are_safe(surface: Surface, T_w_t: Array, limits: touch_sites.SiteLimits) -> Array:
    return jax.vmap(partial(touch_sites.is_safe, surface, limits=limits))(T_w_t)


def predict_outcomes(
    surfaces: Sequence[Surface],
    twist: Float[Array, "k 6"],
    T_w_site: Float[Array | np.ndarray, "sites 4 4"],
    reading_models: Sequence[LinearReadingModel],
    *,
    overtravel: float,
    label: str,
    bar: Progress | None = None,
) -> list[PredictedTouch]:
    """Predict a touch of every object in every pose at every site, with a progress bar.

    Args:
        surfaces: Of the objects.
        twist: Of the pose particles (m).
        T_w_site: Sites.
        reading_models: Of some pads, at the same loads.
        overtravel: Distance (m) beyond a site after which a press gives up.
        label: What the bar says the touches are for.
        bar: A bar of several predictions, which counts these too, instead of one of their own.

    Returns:
        For each pad the predicted touches, (sites, objects, k), on the host.
    """
    by_layer: dict[tuple[float, ...], list[int]] = {}  # a contact is pressed once for all pads of one layer
    for i, model in enumerate(reading_models):
        by_layer.setdefault(tuple(float(part) for part in model.layer), []).append(i)
    most = max(len(some) for some in by_layer.values())
    predicted: dict[int, PredictedTouch] = {}
    total = len(by_layer) * len(surfaces) * len(T_w_site) * len(twist)
    new_bar = partial(progress, total=total, desc=f"{label}: imagining", unit="touch", unit_scale=True)
    with new_bar() if bar is None else nullcontext(bar) as shown:
        for some in by_layer.values():
            models = [reading_models[i] for i in np.resize(some, most)]  # filled up: one compilation serves all layers
            made = _predict_on_layer(surfaces, twist, np.asarray(T_w_site), models, overtravel, shown)
            predicted |= dict(zip(some, made, strict=False))
    return [predicted[i] for i in range(len(reading_models))]


def _predict_on_layer(
    surfaces: Sequence[Surface],
    twist: Array,
    T: np.ndarray,
    models: Sequence[LinearReadingModel],
    overtravel: float,
    bar: Progress,
) -> list[PredictedTouch]:
    each = max(BATCH_TOUCHES // len(twist), 1)
    rows = filled_batches(np.arange(len(T)), each)
    batches = [(number, some) for number in range(len(surfaces)) for some in rows]
    calls = ((surfaces[number], T[some]) for number, some in batches)
    made = spread(_predict_touches, calls, shared=(twist, list(models), overtravel))
    result: list[PredictedTouch] | None = None
    for (number, some), part in zip(batches, made, strict=True):
        if result is None:
            shape = (len(T), len(surfaces))
            result = jax.tree.map(lambda x, shape=shape: np.empty((*shape, *x.shape[1:]), x.dtype), part)
        for whole, values in zip(jax.tree.leaves(result), jax.tree.leaves(part), strict=True):
            whole[some, number] = values
        bar.update(len(np.unique(some)) * len(twist))
    assert result is not None
    return result


@jax.jit
def _predict_touches(
    surface: Surface, T_w_site: Array, twist: Array, reading_models: list[LinearReadingModel], overtravel: Array
) -> list[PredictedTouch]:
    def one(T: Array, x: Array) -> list[PredictedTouch]:
        first = reading_models[0]
        contact = outcomes.predict_contact(
            surface, jnp.eye(4), x, T, first.loads, overtravel=overtravel, layer=first.layer
        )
        return [outcomes.predict_reading(contact, model) for model in reading_models]

    return jax.vmap(lambda T: jax.vmap(lambda x: one(T, x))(twist))(T_w_site)


def plan_random_touches(
    key: Key[Array, ""],
    surfaces: Sequence[Surface],
    names: Sequence[str],
    episodes: int,
    touches: int,
    *,
    limits: touch_sites.SiteLimits,
    share: int = 1,
) -> TouchPlan:
    """Draw a safe site of a random object for each touch.

    Args:
        key: Of the draws.
        surfaces: Of the objects.
        names: Of the objects, for messages.
        episodes: How many.
        touches: Of each episode.
        limits: What makes a site safe.
        share: Episodes, one after the other, that touch the same sites, so that less has to be predicted; with one no
            two touches share a site.

    Returns:
        The plan, with a pool for each `share` episodes.

    Raises:
        ValueError: An object has too few safe sites.
    """
    pool = np.arange(episodes) // share
    count = (int(pool[-1]) + 1) * touches
    key_object, key_sites = jax.random.split(key)
    owner = np.asarray(jax.random.randint(key_object, (count,), 0, len(surfaces)))
    T = np.zeros((len(owner), 4, 4), np.float32)
    for i, (surface, name) in enumerate(zip(surfaces, names, strict=True)):
        T[owner == i] = _draw_sites(jax.random.fold_in(key_sites, i), surface, int((owner == i).sum()), limits, name)
    chosen = np.arange(count).reshape(-1, touches)[pool]
    return TouchPlan(SitePool(jnp.asarray(T), owner), chosen, pool)


def sample_pools(
    key: Key[Array, ""],
    surfaces: Sequence[Surface],
    names: Sequence[str],
    *,
    pools: int,
    each: int,
    limits: touch_sites.SiteLimits,
) -> SitePools:
    """Draw several pools of random safe sites.

    Args:
        key: Of the sites.
        surfaces: Of the objects.
        names: Of the objects, for messages.
        pools: How many.
        each: How many sites of each object in each pool.
        limits: What makes a site safe.

    Returns:
        The pools.

    Raises:
        ValueError: An object has too few safe sites.
    """
    found = [
        _draw_sites(jax.random.fold_in(key, i), surface, pools * each, limits, name).reshape(pools, each, 4, 4)
        for i, (surface, name) in enumerate(zip(surfaces, names, strict=True))
    ]
    return SitePools(np.stack(found, axis=1))


def plan_informative_touches(
    key: Key[Array, ""], pools: SitePools, pool: Int[np.ndarray, " e"], touches: int
) -> TouchPlan:
    """Draw for each touch the site of a random object by the paper's heuristic
    (`i2t.paper.loop.site_informativeness`).

    Args:
        key: Of the draws.
        pools: Of sites.
        pool: Number of each episode's pool.
        touches: Of each episode.

    Returns:
        The plan; its sites are those touched.
    """
    which, site = jax.device_get(_draw_informative(key, pool_informativeness(pools), pool, touches=touches))
    T = pools.T_w_t[pool[:, None], which, site].reshape(-1, 4, 4)
    return TouchPlan(SitePool(jnp.asarray(T), which.reshape(-1)), np.arange(len(T)).reshape(which.shape), pool)


@partial(jit_quickly, static_argnames="touches")
def _draw_informative(
    key: Key[Array, ""], weight: Float[Array, "pools objects each"], pool: Int[Array, " e"], *, touches: int
) -> tuple[Int[Array, "e t"], Int[Array, "e t"]]:
    """Objects and their sites, as the weights have it."""
    key_object, key_site = jax.random.split(key)
    which = jax.random.randint(key_object, (len(pool), touches), 0, weight.shape[1])
    return which, jax.random.categorical(key_site, jnp.log(weight[pool[:, None], which]))


def pool_informativeness(pools: SitePools) -> Float[np.ndarray, "pools objects each"]:
    """The paper's heuristic in each of some pools, all of whose sites are safe.

    Args:
        pools: Of sites.

    Returns:
        Probabilities of the sites of each object, if that one is the hypothesis.
    """
    return np.asarray(_informativeness(jnp.asarray(pools.T_w_t)))


@jax.jit
def _informativeness(T_w_t: Array) -> Array:
    safe, hypotheses = jnp.ones(T_w_t.shape[1:3], bool), jnp.arange(T_w_t.shape[1])

    def of_pool(T: Array) -> Array:
        points, normals = T[..., :3, 3], -T[..., :3, 2]
        return jax.vmap(lambda o: loop.site_informativeness(points, normals, safe, o))(hypotheses)

    return jax.lax.map(of_pool, T_w_t)


def _draw_sites(
    key: Array, surface: Surface, count: int, limits: touch_sites.SiteLimits, name: str
) -> Float[np.ndarray, "{count} 4 4"]:
    """Any number of random safe sites of an object; one compilation serves all objects of a size class."""
    found: list[np.ndarray] = [np.zeros((0, 4, 4), np.float32)]
    have = batches = 0
    while have < count:
        drawn = _draw_batch(jax.random.fold_in(key, batches), surface, limits)
        found.append(np.asarray(drawn.T_w_t)[np.asarray(drawn.safe)])
        have, batches = have + len(found[-1]), batches + 1
        tried = batches * DRAWN_SITES * CANDIDATES_PER_SITE
        if tried * MIN_SAFE_SHARE > have + DRAWN_SITES:
            raise ValueError(
                f"{name} has too few safe sites: {have} among {tried} candidates; lower min_cos or the flange's size, "
                "or raise max_rise"
            )
    return np.concatenate(found)[:count]


@jit_quickly
def _draw_batch(key: Array, surface: Surface, limits: touch_sites.SiteLimits) -> touch_sites.Sites:
    return touch_sites.sample_sites(key, surface, DRAWN_SITES, limits, CANDIDATES_PER_SITE)
