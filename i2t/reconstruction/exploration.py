"""Choice of the next touch of an unknown object.

Sites are proposed on the current estimate of the surface, each with the tool along the estimated normal. Sites that the
limits of `i2t.simulation.site_limits` forbid on the estimated surface are dropped. A policy chooses one of the others;
if none is left, none is chosen and the caller stops.

  random       any site
  uncertainty  the site whose surface is least certain
  reduction    the site whose measurement is expected to reduce the error of the surface most. With cov the posterior
               covariance and q(x) the density of the surface at x, the reduction is
               sum_x q(x) cov(x, c)^2 / (cov(c, c) + noise^2),
               which is exact for a regression whose mean does not move (Krause et al., JMLR 9, 2008)
"""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from i2t.errors import did_you_mean
from i2t.geometry import contact_frame
from i2t.reconstruction.signed_distances import interpolate
from i2t.reconstruction.surface import (
    SurfaceEstimate,
    SurfaceModel,
    SurfacePosterior,
    SurfaceState,
    estimate_surface,
    posterior_covariance,
    predict,
    regress,
)
from i2t.simulation.site_limits import SiteLimits
from i2t.simulation.sites import is_above_table, is_upward

PolicyName = Literal["random", "uncertainty", "reduction"]
# names of the policies that choose the next touch for reconstruction: any safe site, the site whose surface is least
# certain, and the site whose touch is expected to reduce the error of the surface most
POLICY_NAMES: tuple[PolicyName, ...] = ("random", "uncertainty", "reduction")
# Site limits for an object that the tool reaches from all sides: normals of any direction, and a table 1 m below the
# origin, so that mount and flange stay above it.
AROUND_LIMITS = SiteLimits(min_cos=-1.0, table=-1.0)


@dataclass(frozen=True)
class ExplorationConfig:
    """Options for choosing the next touch of an unknown object: policy, safe sites and approach."""

    policy: PolicyName = "reduction"
    # limits of safe sites; by default, the paper's collection on a table
    limits: SiteLimits = field(default_factory=SiteLimits)
    candidates: int = 48  # number of sites proposed at a time
    stride: int = 2  # step of the grid on which sites are sought
    overtravel: float = 10e-3  # m, distance beyond a site at which a touch ends without contact
    noise: float = 2e-3  # m, standard deviation of the expected measurement
    probes: int = 400  # number of surface points over which the error is summed

    def __post_init__(self) -> None:
        if self.policy not in POLICY_NAMES:
            raise ValueError(f"policy {self.policy!r}: is not known; {did_you_mean(self.policy, POLICY_NAMES)}")
        if not 0 <= self.overtravel <= 0.1:
            raise ValueError(f"overtravel {self.overtravel!r} m: give 0 to 0.1 m")


class SiteProposals(NamedTuple):
    """n proposed touch sites on the estimated surface: tool poses in the object's frame, standard deviation (m) of the
    surface, and whether the limits allow each site.
    """

    T_o_t: Float[np.ndarray, "n 4 4"]  # poses of the tool at contact, its z into the object
    std: Float[np.ndarray, " n"]  # m, standard deviation of the surface at the sites
    safe: Bool[np.ndarray, " n"]


class TouchChoice(NamedTuple):
    """Tool pose of the next touch and its score by the policy (None and NaN if no site is safe), and all proposed
    sites.
    """

    T_o_t: Float[np.ndarray, "4 4"] | None  # (4, 4) pose of the tool at the chosen site; None if no site is safe
    score: float  # the policy's score of the site; NaN if no site is safe
    proposals: SiteProposals


def choose_touch(
    model: SurfaceModel,
    state: SurfaceState,
    *,
    config: ExplorationConfig | None = None,
    seed: int = 0,
    estimate: SurfaceEstimate | None = None,
) -> TouchChoice:
    """Choose the next touch of an unknown object, at a safe site on its estimated surface.

    Args:
        model: The prior knowledge of the surface.
        state: The evidence so far.
        config: The policy, the limits of safe sites, and how sites are proposed.
        seed: Seed of the random numbers; the same seed gives the same proposals.
        estimate: The estimated surface of this state; computed if it is not given.

    Returns:
        Chosen site with its score and all proposals; no site if none is safe.
    """
    config = config or ExplorationConfig()
    rng = np.random.default_rng(seed)
    posterior = regress(model, state)
    estimate = estimate or estimate_surface(model, state, stride=config.stride, posterior=posterior)
    proposals = propose_sites(estimate, rng, config=config)
    if not proposals.safe.any():
        return TouchChoice(None, float("nan"), proposals)
    if config.policy == "random":
        scores = rng.random(len(proposals.std))
    elif config.policy == "uncertainty":
        scores = proposals.std
    else:
        at = proposals.T_o_t[:, :3, 3]
        scores = expected_reduction(model, posterior, estimate, at, rng=rng, config=config)
    scores = np.where(proposals.safe, scores, -np.inf)
    best = int(scores.argmax())
    return TouchChoice(proposals.T_o_t[best], float(scores[best]), proposals)


def propose_sites(estimate: SurfaceEstimate, rng: np.random.Generator, *, config: ExplorationConfig) -> SiteProposals:
    """Propose touch sites at random over the estimated surface.

    Args:
        estimate: The estimated surface.
        rng: Random number generator.
        config: The number of sites and the limits of safe sites.

    Returns:
        Sites, `config.candidates` of them or as many as the surface has.
    """
    points, normals, std = surface_points(estimate)
    kept = rng.permutation(len(points))[: config.candidates]
    rolls = rng.uniform(0, 2 * np.pi, len(kept))
    if not len(kept):
        return SiteProposals(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0, bool))
    frames = np.stack([contact_frame(p, n, r) for p, n, r in zip(points[kept], normals[kept], rolls, strict=True)])
    return SiteProposals(frames, std[kept], safe_sites(estimate, frames, config=config))


def surface_points(
    estimate: SurfaceEstimate,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """List points of the estimated surface, about one for each cell of the grid that the surface crosses.

    Args:
        estimate: The estimated surface.

    Returns:
        `(n, 3)` points (m), `(n, 3)` outward unit normals, and `(n,)` standard deviations of the surface (m) there.
    """
    grid = estimate.grid
    field_ = estimate.distance.reshape(grid.shape)
    slopes = np.stack(np.gradient(field_, grid.spacing), -1).reshape(-1, 3)
    steep = np.linalg.norm(slopes, axis=-1)
    near = np.flatnonzero((np.abs(estimate.distance) < 0.5 * grid.spacing * np.maximum(steep, 0.3)) & (steep > 0.1))
    normals = slopes[near] / steep[near, None]
    points = grid.points()[near] - (estimate.distance[near] / steep[near])[:, None] * normals
    return points.astype(np.float64), normals.astype(np.float64), estimate.std[near].astype(np.float64)


def safe_sites(
    estimate: SurfaceEstimate, T_o_t: Float[np.ndarray, "n 4 4"], *, config: ExplorationConfig
) -> Bool[np.ndarray, " n"]:
    """Test which sites the limits allow on the estimated surface.

    The limits concern the tilt, the clearance of mount and flange above the table down to the end of the overtravel,
    and the room above the contact plane in the sensor's square, which the estimated object must leave free.

    Args:
        estimate: The estimated surface.
        T_o_t: Poses of the tool at the sites.
        config: The limits and the overtravel.

    Returns:
        `(n,)` True where the site is safe; False for a pose that is not finite.
    """
    limits, finite = config.limits, np.isfinite(T_o_t).all((1, 2))
    T_o_t = np.where(finite[:, None, None], T_o_t, np.eye(4))
    batch = 16  # a multiple of it has few sizes, and so few compilations
    here = np.resize(T_o_t, (-(-len(T_o_t) // batch) * batch, 4, 4)).astype(np.float32)
    deepest = here.copy()
    deepest[:, :3, 3] += np.float32(config.overtravel) * here[:, :3, 2]
    clear = np.asarray(_stand_clear(here, deepest, limits))[: len(T_o_t)]
    return finite & clear & _unoccluded(estimate, T_o_t, limits)


@jax.jit
def _stand_clear(here: jax.Array, end: jax.Array, limits: SiteLimits) -> jax.Array:
    """Test tilt, mount and flange against the limits at contact and at the end of the overtravel."""

    def stands_clear(here: jax.Array, end: jax.Array) -> jax.Array:
        return is_upward(here, limits) & is_above_table(here, limits) & is_above_table(end, limits)

    return jax.vmap(stands_clear)(here, end)


def _unoccluded(estimate: SurfaceEstimate, T_o_t: np.ndarray, limits: SiteLimits) -> np.ndarray:
    """Test that the estimated object leaves the room above the contact plane free from `max_rise` upwards."""
    edge = np.linspace(-limits.half_edge, limits.half_edge, 5)
    x, y, z = (e.ravel() for e in np.meshgrid(edge, edge, -(limits.max_rise + np.linspace(0, 60e-3, 13))))
    local = np.stack([x, y, z], -1)
    places = np.einsum("nij,kj->nki", T_o_t[:, :3, :3], local) + T_o_t[:, None, :3, 3]
    distance = interpolate(estimate.grid, estimate.distance, places.reshape(-1, 3)).reshape(len(T_o_t), -1)
    return np.asarray((distance >= 0).all(-1))  # False for NaN


def expected_reduction(
    model: SurfaceModel,
    posterior: SurfacePosterior,
    estimate: SurfaceEstimate,
    places: Float[np.ndarray, "n 3"],
    *,
    rng: np.random.Generator,
    config: ExplorationConfig,
) -> Float[np.ndarray, " n"]:
    """Compute the expected reduction of the surface's variance by a measurement at each place, summed over the places
    where the surface may be.

    Args:
        model: The prior knowledge of the surface.
        posterior: Posterior from `i2t.reconstruction.surface.regress`.
        estimate: The estimated surface of the same state.
        places: Points (m) on the estimated surface.
        rng: Random number generator, which draws the points of the sum.
        config: The noise of the measurement and the number of points.

    Returns:
        `(n,)` reductions (m^2), up to a common factor.
    """
    std = estimate.std.astype(np.float64)
    density = np.exp(-0.5 * (estimate.distance / std) ** 2) / std
    drawn = rng.choice(len(density), config.probes, p=density / density.sum())
    cov = posterior_covariance(model, posterior, estimate.grid.points()[drawn], places)
    _, std = predict(model, posterior, places)
    own = std**2 - model.config.band_floor**2  # the variance that a touch can reduce
    return (cov**2).sum(0) / (own + config.noise**2)
