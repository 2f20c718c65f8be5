"""Sites of several objects: safe sites, chosen sites, and the predicted touch of each site on every object.

A pool of sites serves a recogniser that chooses among them, so that touches are predicted once for every object in each
of its possible poses (`predict_outcomes`). Evaluated episodes need separate sites, because episodes that share sites
are not independent: `plan_random_touches` draws the site of every touch anew, and `sample_pools` draws a pool for every
few episodes that choose their sites. Simulated objects stand at the world's origin. The surface of an object that
stands elsewhere is moved there (`place_surfaces`) before sites are drawn and checked, because their safety depends on
its orientation and on the height of the table.
"""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
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
from i2t.runtime.batching import filled_batches, map_on_devices
from i2t.runtime.compiling import compiles_slowly, jit_quickly
from i2t.runtime.progress import Progress, progress
from i2t.simulation import sites as touch_sites
from i2t.simulation.touches import SimulationErrors
from i2t.skin_models.reading_model import LinearReadingModel
from i2t.types import Surface, in_one_line


@dataclass(frozen=True)
class SiteDraws:
    """Sizes of the batches in which safe touch sites are drawn, and the required fraction of safe candidates."""

    sites: int = 256  # number of sites drawn at a time
    candidates_per_site: int = 2  # number of candidates for each site; about half of the candidates are safe
    # smallest fraction of safe candidates; an object with fewer has too few safe sites
    min_safe_fraction: float = 1 / 64


_SITE_DRAWS = SiteDraws()  # sizes of the batches in which safe sites are drawn, and the required fraction of safe ones


@in_one_line
class SitePool(NamedTuple):
    """Safe touch sites of some objects: tool poses at which the skin just touches the surface, and the index of the
    object on which each was drawn.

    Example:
        sites = i2t.SitePool(T_w_t, np.zeros(len(T_w_t), int))  # all drawn on the first object
        recognizer = i2t.ObjectRecognizer(jax.random.key(0), pad_model, meshes, sites=sites)
    """

    T_w_t: Float[Array, "sites 4 4"]  # poses of the tool at which the skin just touches the surface
    owner: Int[np.ndarray, " sites"]  # index of the object on which the site was drawn

    def moved(self, T_a_w: Float[Array | np.ndarray, "4 4"]) -> "SitePool":
        """Express the sites in another frame.

        Args:
            T_a_w: The motion from the sites' frame to the other frame.

        Returns:
            Sites with poses T_a_t.
        """
        poses = np.asarray(T_a_w, float) @ np.asarray(self.T_w_t, float)
        return SitePool(jnp.asarray(poses, jnp.float32), self.owner)


class SitePools(NamedTuple):
    """Tool poses at safe touch sites in separate pools, each with the same number of sites of every object."""

    T_w_t: Float[np.ndarray, "pools objects sites 4 4"]

    def joined(self) -> SitePool:
        """Join all pools into one.

        Returns:
            Pool of all sites; site i of object o in pool p is row (p * objects + o) * sites + i.
        """
        pools, objects, sites = self.T_w_t.shape[:3]
        return SitePool(jnp.asarray(self.T_w_t.reshape(-1, 4, 4)), np.tile(np.repeat(np.arange(objects), sites), pools))


class TouchPlan(NamedTuple):
    """Touches of e episodes, chosen in advance: all sites, indices of the t sites that each episode touches, and the
    index of the pool that it may share with other episodes.
    """

    sites: SitePool
    chosen: Int[np.ndarray, "e t"]  # indices of the touched sites
    pool: Int[np.ndarray, " e"]  # index of each episode's pool; episodes of one pool are not independent


def prepare_surfaces(meshes: Sequence[Any]) -> list[Surface]:
    """Prepare surfaces of one size class, so that one compilation serves all.

    Args:
        meshes: Meshes of the objects.

    Returns:
        Surfaces for rendering, padded to one size.

    Raises:
        ValueError: There are no meshes, or one of them cannot be rendered.

    Example:
        surfaces = i2t.prepare_surfaces([i2t.make_object(name).mesh for name in ("star", "square")])
    """
    if not len(meshes):
        raise ValueError("meshes: is empty; give at least one mesh")
    stacked = stack_surfaces([prepare_surface(mesh) for mesh in meshes])
    return [element(stacked, i) for i in range(len(meshes))]


def place_surfaces(surfaces: Sequence[Surface], T_w_o: Float[Array | np.ndarray, "4 4"]) -> list[Surface]:
    """Move the surfaces of objects to their pose, for drawing and checking sites.

    Args:
        surfaces: Surfaces, each in its object's frame.
        T_w_o: The pose of all objects.

    Returns:
        Surfaces in W that hold triangles only and cannot be rendered.
    """
    rows = np.asarray(T_w_o, float)[:3]

    def place(surface: Surface) -> Surface:
        x, y, z = np.moveaxis(np.asarray(surface.triangles, float), -1, 0)
        # The products are written out, so that the corners of a degenerate face stay equal to the last digit.
        moved = np.stack([row[0] * x + row[1] * y + row[2] * z + row[3] for row in rows], axis=-1)
        return Surface(jnp.asarray(moved, jnp.float32))

    return [place(surface) for surface in surfaces]


def pose_particles(errors: SimulationErrors, count: int, seed: int) -> Particles:
    """Draw the poses in which an object may stand, by the errors of its placement.

    Args:
        errors: Errors of the simulated world, of which those of placement are used.
        count: Number of particles.
        seed: Seed of the quasi-random sequence.

    Returns:
        Pose particles about the believed pose.
    """
    return belief.sample_particles(outcomes.placement_std(errors.placement, errors.placement_angle), count, seed)


def sample_sites(
    key: Key[Array, ""], surfaces: Sequence[Surface], names: Sequence[str], count: int, limits: touch_sites.SiteLimits
) -> SitePool:
    """Draw random safe sites of every object.

    Args:
        key: Random key of the sites.
        surfaces: Surfaces of the objects in the world: at its origin, or moved by `place_surfaces`.
        names: Names of the objects, for messages.
        count: Number of sites of each object.
        limits: Limits of safe sites.

    Returns:
        Pool of the sites, ordered by object.

    Raises:
        ValueError: An object has too few safe sites.
    """
    poses = [
        touch_sites.collect_sites(jax.random.fold_in(key, i), surface, count, limits, name)
        for i, (surface, name) in enumerate(zip(surfaces, names, strict=True))
    ]
    return SitePool(jnp.asarray(np.concatenate(poses)), np.repeat(np.arange(len(surfaces)), count))


def safe_sites(
    surfaces: Sequence[Surface], sites: SitePool, limits: touch_sites.SiteLimits
) -> Bool[np.ndarray, "sites objects"]:
    """Test each site of a pool for safety on each object. A site that was drawn on an object is safe on it.

    Args:
        surfaces: Surfaces of the objects in the world: at its origin, or moved by `place_surfaces`.
        sites: The pool, in the world.
        limits: Limits of safe sites.

    Returns:
        `(sites, objects)` mask of safe touches.
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
        surfaces: Surfaces of the objects.
        twist: Twists (m) of the k pose particles.
        T_w_site: Poses of the sites.
        reading_models: Reading models of some pads, for the same loads.
        overtravel: Distance (m) beyond a site after which a press gives up.
        label: Purpose of the touches, for the bar.
        bar: Bar of several predictions, which also counts these; by default they have their own.

    Returns:
        Predicted touches (sites, objects, k) for each pad, on the host.
    """
    by_layer: dict[tuple[float, ...], list[int]] = {}  # contacts are computed once for all pads of one layer
    for i, model in enumerate(reading_models):
        by_layer.setdefault(tuple(float(part) for part in model.layer), []).append(i)
    largest = max(len(numbers) for numbers in by_layer.values())
    predicted: dict[int, PredictedTouch] = {}
    total = len(by_layer) * len(surfaces) * len(T_w_site) * len(twist)
    new_bar = partial(progress, total=total, desc=f"{label}: predicting", unit="touches", unit_scale=True)
    with new_bar() if bar is None else nullcontext(bar) as shown:
        for numbers in by_layer.values():
            # Groups are filled up to one size, so that one compilation serves all layers.
            models = [reading_models[i] for i in np.resize(numbers, largest)]
            touches = _predict_on_layer(surfaces, twist, np.asarray(T_w_site), models, overtravel, shown)
            predicted |= dict(zip(numbers, touches, strict=False))
    return [predicted[i] for i in range(len(reading_models))]


def _predict_on_layer(
    surfaces: Sequence[Surface],
    twist: Array,
    T: np.ndarray,
    models: Sequence[LinearReadingModel],
    overtravel: float,
    bar: Progress,
) -> list[PredictedTouch]:
    rows = filled_batches(np.arange(len(T)), max(512 // len(twist), 1))  # about 512 touches at a time
    batches = [(number, some) for number in range(len(surfaces)) for some in rows]
    calls = ((surfaces[number], T[some]) for number, some in batches)
    parts = map_on_devices(_predict_touches, calls, shared=(twist, list(models), overtravel))
    result: list[PredictedTouch] | None = None
    for (number, some), part in zip(batches, parts, strict=True):
        if result is None:
            shape = (len(T), len(surfaces))
            result = jax.tree.map(lambda x, shape=shape: np.empty((*shape, *x.shape[1:]), x.dtype), part)
        for whole, values in zip(jax.tree.leaves(result), jax.tree.leaves(part), strict=True):
            whole[some, number] = values
        bar.update(len(np.unique(some)) * len(twist))
    assert result is not None
    return result


@jax.jit
@compiles_slowly("the prediction of touches", seconds=3)
def _predict_touches(
    surface: Surface, T_w_site: Array, twist: Array, reading_models: list[LinearReadingModel], overtravel: Array
) -> list[PredictedTouch]:
    def predict(T: Array, x: Array) -> list[PredictedTouch]:
        first = reading_models[0]
        contact = outcomes.predict_contact(
            surface, jnp.eye(4), x, T, first.loads, overtravel=overtravel, layer=first.layer
        )
        return [outcomes.predict_reading(contact, model) for model in reading_models]

    return jax.vmap(lambda T: jax.vmap(lambda x: predict(T, x))(twist))(T_w_site)


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
        key: Random key of the draws.
        surfaces: Surfaces of the objects.
        names: Names of the objects, for messages.
        episodes: Number of episodes.
        touches: Number of touches of each episode.
        limits: Limits of safe sites.
        share: Number of consecutive episodes with the same sites, which reduces the number of predictions. With 1, all
            touches have different sites.

    Returns:
        Plan with one pool for each `share` episodes.

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
    per_object: int,
    limits: touch_sites.SiteLimits,
) -> SitePools:
    """Draw several pools of random safe sites.

    Args:
        key: Random key of the sites.
        surfaces: Surfaces of the objects.
        names: Names of the objects, for messages.
        pools: Number of pools.
        per_object: Number of sites of each object in each pool.
        limits: Limits of safe sites.

    Returns:
        Pools with equal numbers of sites.

    Raises:
        ValueError: An object has too few safe sites.
    """
    poses = [
        _draw_sites(jax.random.fold_in(key, i), surface, pools * per_object, limits, name)
        for i, (surface, name) in enumerate(zip(surfaces, names, strict=True))
    ]
    return SitePools(np.stack([T.reshape(pools, per_object, 4, 4) for T in poses], axis=1))


def plan_informative_touches(
    key: Key[Array, ""], pools: SitePools, pool: Int[np.ndarray, " e"], touches: int
) -> TouchPlan:
    """Draw for each touch a site of a random object by the paper's heuristic (`i2t.paper.loop.site_informativeness`).

    Args:
        key: Random key of the draws.
        pools: Pools of sites.
        pool: Index of each episode's pool.
        touches: Number of touches of each episode.

    Returns:
        Plan whose sites are the touched ones.
    """
    which, site = jax.device_get(_draw_informative(key, pool_informativeness(pools), pool, touches=touches))
    T = pools.T_w_t[pool[:, None], which, site].reshape(-1, 4, 4)
    return TouchPlan(SitePool(jnp.asarray(T), which.reshape(-1)), np.arange(len(T)).reshape(which.shape), pool)


@partial(jit_quickly, static_argnames="touches")
def _draw_informative(
    key: Key[Array, ""], weight: Float[Array, "pools objects sites"], pool: Int[Array, " e"], *, touches: int
) -> tuple[Int[Array, "e t"], Int[Array, "e t"]]:
    """Draw objects, and sites of them in proportion to their weights."""
    key_object, key_site = jax.random.split(key)
    which = jax.random.randint(key_object, (len(pool), touches), 0, weight.shape[1])
    return which, jax.random.categorical(key_site, jnp.log(weight[pool[:, None], which]))


def pool_informativeness(pools: SitePools) -> Float[np.ndarray, "pools objects sites"]:
    """Compute the paper's heuristic for some pools, all of whose sites are safe.

    Args:
        pools: Pools of sites.

    Returns:
        `(pools, objects, sites)` probabilities of the sites of each object, given that it is the hypothesis.
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
    """Draw any number of random safe sites of an object. One compilation serves all objects of a size class."""
    poses: list[np.ndarray] = [np.zeros((0, 4, 4), np.float32)]
    have = batches = 0
    while have < count:
        drawn = _draw_batch(jax.random.fold_in(key, batches), surface, limits)
        poses.append(np.asarray(drawn.T_w_t)[np.asarray(drawn.safe)])
        have, batches = have + len(poses[-1]), batches + 1
        tried = batches * _SITE_DRAWS.sites * _SITE_DRAWS.candidates_per_site
        if tried * _SITE_DRAWS.min_safe_fraction > have + _SITE_DRAWS.sites:
            raise ValueError(
                f"{name} has too few safe sites: {have} among {tried} candidates; lower min_cos or the flange's size, "
                "or raise max_rise"
            )
    return np.concatenate(poses)[:count]


@jit_quickly
def _draw_batch(key: Array, surface: Surface, limits: touch_sites.SiteLimits) -> touch_sites.Sites:
    return touch_sites.sample_sites(key, surface, _SITE_DRAWS.sites, limits, _SITE_DRAWS.candidates_per_site)
