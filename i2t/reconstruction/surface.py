"""An unknown object's surface from a few touches, with the uncertainty of every part of it.

The surface is where a signed distance f (m, negative inside) is zero. Before the first touch f is a Gaussian process
whose mean and covariance are those of a library of other shapes (`i2t.reconstruction.shape_library`), plus a stationary
part for shapes that the library lacks. An empty library leaves a prior of smoothness alone, around a ball.

    f = sum_k w_k f_k + residual,   cov = sum_k w_k (f_k - m)(f_k - m)' + s^2 Matern_{5/2}(r / l)

A touch or a view gives up to three kinds of evidence (`i2t.reconstruction.evidence`): points whose signed distance is
given, a pad that meets the surface somewhere, and space that is free. The library's weights follow from how well each
shape agrees (a Student's t likelihood, tempered because the points of a touch are not independent). The remainder is a
linear regression on the points, with points of free space where the mean would break in. Finally the free space is
carved out exactly. Frames as in `i2t.types`, O the object.

    model = surface_model(meshes)
    state, _ = init(model)
    state, info = update(model, state, contact_evidence(T_o_t))
    estimate = estimate_surface(model, state)

This module uses NumPy because sizes change from touch to touch, and dense linear algebra of a few hundred points takes
most of the time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_solve, solve_triangular
from scipy.special import logsumexp

from i2t.errors import require_extra
from i2t.objects.solids import Mesh
from i2t.reconstruction.evidence import SurfaceEvidence, Sweep, with_surface_points
from i2t.reconstruction.shape_library import TURNS, ShapeLibrary, shape_library
from i2t.reconstruction.signed_distances import VoxelGrid, corners_of, extract_mesh
from i2t.types import Array


@dataclass(frozen=True)
class SurfaceConfig:
    """Assumptions for estimating an unknown object's surface: shapes, smoothness and errors of the evidence."""

    across: int = 32  # number of points of the grid along x and along y
    margin: float = 6e-3  # m, margin of the grid around the shapes
    on_table: bool = True  # whether objects stand on z = 0; otherwise their box is about the origin
    shapes: int = 128  # number of shapes that represent the whole library, by weight
    likeliest: bool = False  # whether the likeliest shapes represent it, instead of shapes drawn by weight
    temperature: float = 2.0  # divisor of the log likelihoods of shapes
    misfit: float = 1.5e-3  # m, scale of the distance between a shape of the library and a similar unknown object
    dof: float = 4.0  # degrees of freedom of the misfit's Student's t distribution
    residual: float = 1.5e-3  # m, standard deviation of the part of the surface that no shape of the library has
    length: float = 8e-3  # m, correlation length of the part of the surface that no shape of the library has
    smooth_residual: float = 15e-3  # m, `residual` for an empty library
    smooth_length: float = 25e-3  # m, `length` for an empty library
    radius: float = 30e-3  # m, radius of the ball that replaces an empty library
    pose_std: float = 0.3e-3  # m, standard deviation of every point due to the uncertainty of the tool's pose
    contact_std: float = 2e-3  # m, standard deviation of a contact whose point in the pad's square is a guess
    free_tolerance: float = 0.5e-3  # m, distance by which the mean surface may enter free space
    free_std: float = 1e-3  # m, standard deviation of the points that keep the mean surface out of free space
    # largest number of points of a touch or view that keep the mean out of free space in each of two rounds
    free_points: int = 4
    band_scale: float = 1.0  # factor on all standard deviations; `experiments.reconstruct` chooses it and `band_floor`
    band_floor: float = 1e-3  # m, standard deviation that no touch reduces, from the resolution of the grid


class SurfaceModel(NamedTuple):
    """Prior knowledge of an unknown object's surface: a library of k shapes, the g points (m) of its grid, and
    assumptions on shapes and evidence.
    """

    library: ShapeLibrary
    points: Float[np.ndarray, "g 3"]  # m, points of the library's grid
    config: SurfaceConfig

    @property
    def grid(self) -> VoxelGrid:
        """The grid of all signed distances."""
        return self.library.grid


class SurfaceState(NamedTuple):
    """Evidence of all touches and views of an unknown object so far, log weights of the library's shapes (neither
    normalised nor tempered), and lower bounds (m) of the signed distance at the grid's points.
    """

    log_weights: Float[np.ndarray, " k"]  # log weights of the library's shapes, neither normalised nor tempered
    evidence: tuple[SurfaceEvidence, ...]
    bound: Float[np.ndarray, " g"]  # m, lower bounds of the signed distance from free space; -inf elsewhere


class SurfaceInfo(NamedTuple):
    """Log likelihood of the latest touch or view under each shape of the library, and the effective number of shapes
    that remain plausible after all evidence.
    """

    log_likelihood: Float[np.ndarray, " k"]  # log likelihood of the evidence under each shape of the library
    effective_shapes: float  # effective sample size of the weights


class SurfaceEstimate(NamedTuple):
    """Estimated surface: signed distance (m, negative inside) at the grid's g points, with its standard deviation."""

    grid: VoxelGrid
    distance: Float[np.ndarray, " g"]  # m, signed distance to the surface
    std: Float[np.ndarray, " g"]  # m, standard deviation of the signed distance

    @property
    def mesh(self) -> Mesh:
        """Mesh of the surface in metres, in the object's frame; needs scikit-image."""
        return extract_mesh(self.grid, self.distance)


class SurfacePrior(NamedTuple):
    """Prior of the signed distance at the grid's g points: its mean (m), and the deviations (m) of m shapes of the
    library from it, times the square roots of their weights, so that their products are the covariance.
    """

    mean: Float[np.ndarray, " g"]  # m, prior mean of the signed distance
    # m, deviations of the shapes that count, times the square roots of their weights
    deviations: Float[np.ndarray, "g m"]


class SurfacePosterior(NamedTuple):
    """Posterior of the signed distance, which `predict` evaluates anywhere: the prior, the n points (m) on which it is
    regressed, and the factor and solution of that regression.
    """

    prior: SurfacePrior
    points: Float[np.ndarray, "n 3"]  # m, points of the regression
    deviations: Float[np.ndarray, "n m"]  # the prior's deviations at `points`
    factor: Float[np.ndarray, "n n"]  # lower Cholesky factor of the covariance of `points`
    alpha: Float[np.ndarray, " n"]  # 1/m, covariance of `points` solved for the errors of the prior mean


def surface_model(
    meshes: Sequence[Mesh],
    *,
    config: SurfaceConfig | None = None,
    low: Array = (-40e-3, -40e-3, 0.0),
    high: Array = (40e-3, 40e-3, 50e-3),
) -> SurfaceModel:
    """Build a model whose library is the given shapes on all their sides, turned and mirrored about z.

    Args:
        meshes: Closed meshes in metres; an empty sequence gives a prior of smoothness alone.
        config: Assumptions on shapes and evidence.
        low: (3,) lowest corner (m) of the box that objects are in; shapes may enlarge it.
        high: (3,) highest corner (m) of that box.

    Returns:
        Prior knowledge of the surface, without evidence.

    Raises:
        ValueError: A mesh is empty, not finite, or not of a size that can be touched.
        MissingExtraError: scikit-image, which extracts the surface in the end, is not installed.
    """
    require_extra("skimage", "a mesh of signed distances")  # fails here rather than after all touches
    config = config or SurfaceConfig()
    smallest, largest = 2e-3, 1.0  # m
    for number, mesh in enumerate(meshes):
        across = np.ptp(mesh.vertices, axis=0).max() if len(mesh.faces) else 0.0
        if not smallest < across < largest:
            raise ValueError(
                f"mesh {number} of the library is {across:g} m across; {smallest:g} to {largest:g} m are "
                "allowed: check its unit, and that it has faces"
            )
    library = shape_library(
        meshes,
        across=config.across,
        margin=config.margin,
        low=np.asarray(low, float),
        high=np.asarray(high, float),
        on_table=config.on_table,
    )
    return SurfaceModel(library, library.grid.points(), config)


def init(model: SurfaceModel) -> tuple[SurfaceState, SurfaceInfo]:
    """Return the state of a surface estimate before the first touch.

    Args:
        model: The prior knowledge of the surface.

    Returns:
        State without evidence, and its info with the number of effective shapes.
    """
    shapes = np.zeros(model.library.size)
    return SurfaceState(shapes, (), np.full(len(model.points), -np.inf)), SurfaceInfo(shapes, float(len(shapes)))


def update(model: SurfaceModel, state: SurfaceState, evidence: SurfaceEvidence) -> tuple[SurfaceState, SurfaceInfo]:
    """Update the surface state with the evidence of one more touch or view.

    Args:
        model: The prior knowledge of the surface.
        state: The evidence so far.
        evidence: The evidence of this touch or view.

    Returns:
        New state, and the log likelihood of this evidence under each shape of the library.

    Raises:
        ValueError: No point that the touch or view met is inside the box that objects are in.
    """
    met = evidence.pad_points if evidence.is_contact else evidence.points
    low, high = model.points.min(0), model.points.max(0)
    if len(met) and not ((met > low) & (met < high)).all(1).any():
        raise ValueError(
            f"a touch or view met something about {np.round(met.mean(0), 3)} m, outside the box of the surface, "
            f"{np.round(low, 3)} to {np.round(high, 3)} m; check its pose and unit, or give a larger box (low, high)"
        )
    log_likelihood = _log_likelihood(model, evidence)
    bound = np.maximum(state.bound, evidence.region.lower_bound(model.points))
    after = SurfaceState(state.log_weights + log_likelihood, (*state.evidence, evidence), bound)
    return after, SurfaceInfo(log_likelihood, _effective(model, after))


def regress(model: SurfaceModel, state: SurfaceState) -> SurfacePosterior:
    """Compute the posterior of the signed distance: weigh the library's shapes, and regress the rest on all evidence.

    Args:
        model: The prior knowledge of the surface.
        state: The evidence so far.

    Returns:
        Posterior that `predict` evaluates.
    """
    prior = weighted_prior(model, state)
    points, values, std = _evidence_points(model, state, prior)
    posterior = condition_on(model, prior, points=points, values=values, std=std)
    held = [np.zeros(0, int)] * len(state.evidence)
    for _ in range(2):  # the second round keeps out what the first one pushed into other free space
        broken = [_broken(model, posterior, evidence) for evidence in state.evidence]
        if not sum(map(len, broken)):
            break
        held = [np.union1d(*rows) for rows in zip(held, broken, strict=True)]
        free = np.concatenate([evidence.free[rows] for evidence, rows in zip(state.evidence, held, strict=True)])
        bound = np.concatenate([evidence.free_bound[rows] for evidence, rows in zip(state.evidence, held, strict=True)])
        posterior = condition_on(
            model,
            prior,
            points=np.concatenate([points, free]),
            values=np.concatenate([values, bound]),
            std=np.concatenate([std, np.full(len(free), model.config.free_std)]),
        )
    return posterior


def weighted_prior(model: SurfaceModel, state: SurfaceState) -> SurfacePrior:
    """Compute the weighted mean of the library's shapes, and their deviations from it.

    Args:
        model: The prior knowledge of the surface, with the library.
        state: The evidence so far, with the weights.

    Returns:
        Prior of the regression, without its stationary part.
    """
    log_w = state.log_weights / model.config.temperature
    count = min(model.config.shapes, len(log_w))
    if not count:
        middle = np.array([0.0, 0.0, 0.5 * (model.points[0, 2] + model.points[-1, 2])])
        ball = np.linalg.norm(model.points - middle, axis=-1) - model.config.radius
        return SurfacePrior(ball.astype(np.float32), np.zeros((len(ball), 0), np.float32))
    weight = np.exp(log_w - logsumexp(log_w))
    pick = most_probable_shapes if model.config.likeliest and state.evidence else subsample
    shapes, weights = pick(weight, count)
    deviations = model.library.fields(shapes)
    mean = deviations @ weights
    deviations -= mean[:, None]
    deviations *= np.sqrt(weights)
    return SurfacePrior(mean, deviations)


def subsample(weight: Float[np.ndarray, " n"], count: int) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Choose a few weighted shapes that represent many, after Fearnhead and Clifford (J. R. Statist. Soc. B 65, 2003).

    Shapes with large weights are kept. Some of the others are drawn, evenly by weight and without random numbers, and
    share the remaining weight. The likeliest shapes alone would not do: after few touches they are thin and small
    shapes, which touches hardly reach.

    Args:
        weight: Weights of all shapes, which sum to 1.
        count: Number of shapes to choose.

    Returns:
        `(m,)` indices of the chosen shapes, and `(m,)` weights that sum to 1.
    """
    order = np.argsort(-weight, kind="stable")
    ranked = weight[order]
    to_come = np.cumsum(ranked[::-1])[::-1][:count]
    is_kept = ranked[:count] * (count - np.arange(count)) >= to_come
    kept = int(np.append(is_kept, False).argmin())
    rest, places = np.sort(order[kept:]), count - kept
    total = np.append(0.0, np.cumsum(weight[rest]))
    drawn = np.searchsorted(total, (np.arange(places) + 0.5) / max(places, 1) * total[-1]) - 1
    weights = np.append(ranked[:kept], np.full(places, total[-1] / max(places, 1)))
    return np.append(order[:kept], rest[drawn]), weights.astype(np.float32)


def most_probable_shapes(
    weight: Float[np.ndarray, " n"], count: int
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Choose the shapes with the largest weights, without others that represent the rest as in `subsample`.

    Args:
        weight: Weights of all shapes, which sum to 1.
        count: Number of shapes to choose.

    Returns:
        `(m,)` indices of the chosen shapes, and `(m,)` weights that sum to 1.
    """
    shapes = np.argpartition(-weight, count - 1)[:count]
    return shapes, (weight[shapes] / weight[shapes].sum()).astype(np.float32)


def condition_on(
    model: SurfaceModel,
    prior: SurfacePrior,
    *,
    points: Float[np.ndarray, "n 3"],
    values: Float[np.ndarray, " n"],
    std: Float[np.ndarray, " n"],
) -> SurfacePosterior:
    """Regress the signed distance on its values at some points.

    Args:
        model: The prior knowledge of the surface.
        prior: The prior of the library's shapes.
        points: Points (m).
        values: Signed distances (m) at the points, negative inside.
        std: Standard deviations (m) of the values.

    Returns:
        Posterior that `predict` evaluates.
    """
    mean, deviations = _prior_at(model, prior, points)
    cov = (deviations @ deviations.T + _matern(model, points, points)).astype(np.float64) + np.diag(std**2 + 1e-9)
    factor = np.linalg.cholesky(cov)
    alpha = cho_solve((factor, True), values - mean, check_finite=False) if len(points) else np.zeros(0)
    return SurfacePosterior(prior, points, deviations, factor.astype(np.float32), alpha.astype(np.float32))


def predict(
    model: SurfaceModel,
    posterior: SurfacePosterior,
    points: Float[np.ndarray, "q 3"] | Int[np.ndarray, " q"],
    *,
    spread: bool = True,
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    """Predict mean and standard deviation of the signed distance at any points, without carving.

    Args:
        model: The model of the posterior.
        posterior: Posterior from `regress`.
        points: `(q, 3)` points (m), or `(q,)` indices of points of the model's grid, which is faster.
        spread: Whether to compute standard deviations, which cost more than means.

    Returns:
        `(q,)` means (negative inside) and `(q,)` standard deviations (m); the latter are zeros without `spread`.
    """
    prior, deviations = _prior_at(model, posterior.prior, points)
    matern = _matern(model, model.points[points] if points.ndim == 1 else points, posterior.points)
    if not spread:
        change = matern @ posterior.alpha + deviations @ (posterior.deviations.T @ posterior.alpha)
        return prior + change, np.zeros(len(points))
    cross = matern + deviations @ posterior.deviations.T
    mean = prior + cross @ posterior.alpha
    config = model.config
    variance = np.einsum("qm,qm->q", deviations, deviations) + _residual(model)[0] ** 2
    variance = variance - (_whitened(posterior, cross) ** 2).sum(0)
    return mean, np.hypot(config.band_scale * np.sqrt(np.maximum(variance, 1e-10)), config.band_floor)


def posterior_covariance(
    model: SurfaceModel, posterior: SurfacePosterior, a: Float[np.ndarray, "p 3"], b: Float[np.ndarray, "q 3"]
) -> Float[np.ndarray, "p q"]:
    """Compute the covariance of the signed distance between two sets of points, without `band_floor`, which no touch
    reduces.

    Args:
        model: The model of the posterior.
        posterior: Posterior from `regress`.
        a: `(p, 3)` first points (m).
        b: `(q, 3)` second points (m).

    Returns:
        `(p, q)` covariances (m^2).
    """
    (_, left), (_, right) = (_prior_at(model, posterior.prior, points) for points in (a, b))
    white_a, white_b = (
        _whitened(posterior, _matern(model, points, posterior.points) + deviations @ posterior.deviations.T)
        for points, deviations in ((a, left), (b, right))
    )
    covariance = left @ right.T + _matern(model, a, b) - white_a.T @ white_b
    return covariance * model.config.band_scale**2


def estimate_surface(
    model: SurfaceModel, state: SurfaceState, *, stride: int = 1, posterior: SurfacePosterior | None = None
) -> SurfaceEstimate:
    """Estimate the signed distance on the grid, with free space carved out.

    Args:
        model: The prior knowledge of the surface.
        state: The evidence so far.
        stride: Step in grid points along each axis.
        posterior: Posterior from `regress`; computed if it is not given.

    Returns:
        Mean and standard deviation of the signed distance on the thinned grid.
    """
    numbers = np.arange(len(model.points)).reshape(model.grid.shape)[::stride, ::stride, ::stride]
    grid, rows = VoxelGrid(model.grid.low, model.grid.spacing * stride, numbers.shape), numbers.ravel()
    mean, std = predict(model, posterior or regress(model, state), rows)
    return SurfaceEstimate(grid, np.maximum(mean, state.bound[rows]).astype(np.float32), std.astype(np.float32))


def _student(x: np.ndarray, dof: float) -> np.ndarray:
    """Log density of a Student's t, without its constant."""
    return -0.5 * (dof + 1) * np.log1p(x**2 / dof)


def _log_likelihood(model: SurfaceModel, evidence: SurfaceEvidence) -> np.ndarray:
    """Compute the log likelihood of evidence under each shape of the library, ordered by turn."""
    config, total = model.config, []
    every = np.concatenate([evidence.free, evidence.pad_points, evidence.points])
    parts = np.cumsum([len(evidence.free), len(evidence.pad_points)])
    for turn in range(len(TURNS)):
        free, pad, surface = np.split(model.library.near(every, turn), parts)
        log_likelihood = np.zeros(surface.shape[1])
        if len(free):
            intrusion = np.minimum(free - evidence.free_bound[:, None], 0).min(0)
            log_likelihood += _student(intrusion / config.misfit, config.dof)
        if len(pad):  # also for a touch with a reading, because no part of the surface lies behind the pad's plane
            log_likelihood += _student(pad.min(0) / config.misfit, config.dof)
        if len(surface):
            scale = np.hypot(config.misfit, evidence.std)[:, None]
            error = (surface - evidence.values[:, None]) / scale
            log_likelihood += evidence.observations * _student(error, config.dof).mean(0)
        total.append(log_likelihood)
    return np.concatenate(total)


def _effective(model: SurfaceModel, state: SurfaceState) -> float:
    if not len(state.log_weights):
        return 0.0
    log_w = state.log_weights / model.config.temperature
    return float(np.exp(2 * logsumexp(log_w) - logsumexp(2 * log_w)))


def _residual(model: SurfaceModel) -> tuple[float, float]:
    """Return standard deviation and correlation length (m) of the stationary part."""
    config = model.config
    return (config.residual, config.length) if model.library.size else (config.smooth_residual, config.smooth_length)


def _matern(model: SurfaceModel, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the Matern 5/2 covariance of the part that is not in the library."""
    std, length = _residual(model)
    a, b = (np.asarray(points, np.float32) * np.float32(np.sqrt(5) / length) for points in (a, b))
    square = np.maximum(a @ (-2 * b.T) + (a**2).sum(-1)[:, None] + (b**2).sum(-1), 0)
    r = np.sqrt(square)
    return (square * np.float32(1 / 3) + r + 1) * np.exp(-r) * np.float32(std**2)


def _prior_at(model: SurfaceModel, prior: SurfacePrior, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate the prior's mean and deviations at points, or at indices of grid points."""
    if points.ndim == 1:
        return prior.mean[points], prior.deviations[points]
    index, weight = corners_of(model.grid, points)
    return (prior.mean[index] * weight).sum(1), np.einsum("ncm,nc->nm", prior.deviations[index], weight)


def _whitened(posterior: SurfacePosterior, cross: np.ndarray) -> np.ndarray:
    """Whiten covariances (q, n) with the points of the regression by the covariance of these points."""
    if not len(posterior.points):
        return np.zeros((0, len(cross)), np.float32)
    return solve_triangular(posterior.factor, cross.T, lower=True, check_finite=False)


def _evidence_points(
    model: SurfaceModel, state: SurfaceState, prior: SurfacePrior
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Collect points, signed distances and standard deviations of all evidence. A touch without its own points gives
    the point of its pad's square where the surface is expected to be nearest.
    """
    config = model.config
    points, values, std = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0)]
    for evidence in state.evidence:
        if not len(evidence.points) and evidence.is_contact:
            evidence = _with_guess(model, prior, evidence)
        points.append(evidence.points)
        values.append(evidence.values)
        std.append(np.hypot(evidence.std, config.pose_std))
    return np.concatenate(points), np.concatenate(values), np.concatenate(std)


def _with_guess(model: SurfaceModel, prior: SurfacePrior, touch: SurfaceEvidence) -> SurfaceEvidence:
    """Add to a touch without points the point of its pad where the shapes expect the surface."""
    assert isinstance(touch.region, Sweep)
    nearest = touch.pad_points[[int(_prior_at(model, prior, touch.pad_points)[0].argmin())]]
    local = (nearest - touch.region.T_o_t[:3, 3]) @ touch.region.T_o_t[:3, :3]
    return with_surface_points(touch, local, np.array([model.config.contact_std]))


def _broken(model: SurfaceModel, posterior: SurfacePosterior, evidence: SurfaceEvidence) -> Int[np.ndarray, " r"]:
    """Find the free points that the mean violates most: a few rows of each touch or view."""
    excess = predict(model, posterior, evidence.free, spread=False)[0] - evidence.free_bound
    worst = np.argsort(excess)[: model.config.free_points]
    return worst[excess[worst] < -model.config.free_tolerance]
