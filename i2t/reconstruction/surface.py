"""An unknown object's surface from a few touches, with the uncertainty of every part of it.

The surface is where a signed distance f (m, negative inside) is zero. Before the first touch f is a Gaussian process
whose mean and covariance are those of a library of other shapes (`i2t.reconstruction.shape_library`), plus a stationary
part for what the library does not hold; a library of none leaves a prior of smoothness alone, around a ball.

    f = sum_k w_k f_k + residual,   cov = sum_k w_k (f_k - m)(f_k - m)' + s^2 Matern_{5/2}(r / l)

A touch or a view is evidence of up to three kinds (`i2t.reconstruction.evidence`): points whose signed distance is
known, a pad of which some point lies on the surface, and space that is free. The library's weights follow from how
well each shape agrees (a Student's t likelihood, tempered, since a touch's points are not independent). What is left is
a linear regression on the points, with points of free space where the mean would break in; in the end space that is
known to be free is carved out exactly. Frames as in `i2t.types`, O the object.

    model = surface_model(meshes)
    state, _ = init(model)
    state, info = update(model, state, contact_evidence(T_o_t))
    estimate = estimate_surface(model, state)

NumPy: sizes change from touch to touch, and dense linear algebra of a few hundred points takes most of the time.
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

MIN_ACROSS_M, MAX_ACROSS_M = 2e-3, 1.0  # of a shape of the library


@dataclass(frozen=True)
class SurfaceConfig:
    """Assumptions on shapes, and on how far evidence may be wrong."""

    across: int = 32  # points of the grid along x and along y
    margin: float = 6e-3  # m, of the grid around the shapes
    on_table: bool = True  # whether objects stand on z = 0, or their box is about the origin
    shapes: int = 128  # that stand for the whole library, by weight
    likeliest: bool = False  # whether the likeliest shapes stand for it, in place of shapes drawn by weight
    temperature: float = 2.0  # by which log likelihoods of shapes are divided
    misfit: float = 1.5e-3  # m, by which a known shape may miss an unknown object and still be like it
    dof: float = 4.0  # of the Student's t of that misfit
    residual: float = 1.5e-3  # m, standard deviation s of what no shape of the library has
    length: float = 8e-3  # m, of its correlation
    smooth_residual: float = 15e-3  # m, the same where there is no library
    smooth_length: float = 25e-3  # m
    radius: float = 30e-3  # m, of the ball that stands for a library of none
    pose_std: float = 0.3e-3  # m, of every point, from what the tool's pose is uncertain by
    contact_std: float = 2e-3  # m, where the point of contact in the pad's square is a guess
    free_tolerance: float = 0.5e-3  # m by which the mean may break into free space
    free_std: float = 1e-3  # m
    free_points: int = 4  # of a touch or view, at most, that hold the mean out of free space in each of two rounds
    band_scale: float = 1.0  # of all standard deviations; `experiments.reconstruct` chooses both for its objects
    band_floor: float = 1e-3  # m, standard deviation that no touch takes away: what the grid cannot hold


class SurfaceModel(NamedTuple):
    """Prior knowledge of the surface."""

    library: ShapeLibrary
    points: Float[np.ndarray, "g 3"]  # m, of its grid
    config: SurfaceConfig

    @property
    def grid(self) -> VoxelGrid:
        """The grid of all signed distances."""
        return self.library.grid


class SurfaceState(NamedTuple):
    """What all evidence says."""

    log_weights: Float[np.ndarray, " k"]  # of the library's shapes, not normalised, not tempered
    evidence: tuple[SurfaceEvidence, ...]
    bound: Float[np.ndarray, " g"]  # m, below which no point of the grid is, as far as space is free; -inf elsewhere


class SurfaceInfo(NamedTuple):
    """Result of an update."""

    log_likelihood: Float[np.ndarray, " k"]  # of the evidence under each shape of the library
    effective_shapes: float  # effective sample size of the weights


class SurfaceEstimate(NamedTuple):
    """A signed distance on the grid, with its spread."""

    grid: VoxelGrid
    distance: Float[np.ndarray, " g"]  # m
    std: Float[np.ndarray, " g"]  # m

    @property
    def mesh(self) -> Mesh:
        """The surface in metres, in the object's frame; needs scikit-image."""
        return extract_mesh(self.grid, self.distance)


class SurfacePrior(NamedTuple):
    """Mean and covariance by the library's weighted shapes, on the grid."""

    mean: Float[np.ndarray, " g"]  # m
    deviations: Float[np.ndarray, "g m"]  # m, of the shapes that count, times the root of their weights


class SurfacePosterior(NamedTuple):
    """The regression on a state's points, to be evaluated anywhere."""

    prior: SurfacePrior
    points: Float[np.ndarray, "n 3"]  # m, that were regressed on
    deviations: Float[np.ndarray, "n m"]  # the prior's at them
    factor: Float[np.ndarray, "n n"]  # lower Cholesky factor of their covariance
    alpha: Float[np.ndarray, " n"]  # 1/m, what the prior missed there, solved by that factor


def surface_model(
    meshes: Sequence[Mesh],
    *,
    config: SurfaceConfig | None = None,
    low: Array = (-40e-3, -40e-3, 0.0),
    high: Array = (40e-3, 40e-3, 50e-3),
) -> SurfaceModel:
    """A model whose library are the given shapes, on all their sides, turned and mirrored about z.

    Args:
        meshes: Closed meshes in metres; none for a prior of smoothness alone.
        config: What is assumed.
        low: (3,) m, lowest corner of the box that objects are known to be in; shapes may enlarge it.
        high: (3,) m, its highest corner.

    Returns:
        The model.

    Raises:
        ValueError: A mesh is empty, not finite, or of no size to touch.
        MissingExtraError: scikit-image is missing, which makes the surface in the end.
    """
    require_extra("skimage", "a mesh of signed distances")  # here, and not after all touches
    config = config or SurfaceConfig()
    for number, mesh in enumerate(meshes):
        across = np.ptp(mesh.vertices, axis=0).max() if len(mesh.faces) else 0.0
        if not MIN_ACROSS_M < across < MAX_ACROSS_M:
            raise ValueError(
                f"mesh {number} of the library is {across:g} m across; {MIN_ACROSS_M:g} to {MAX_ACROSS_M:g} m are "
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
    """State before the first touch.

    Args:
        model: What is known.

    Returns:
        The state, and what it holds.
    """
    shapes = np.zeros(model.library.size)
    return SurfaceState(shapes, (), np.full(len(model.points), -np.inf)), SurfaceInfo(shapes, float(len(shapes)))


def update(model: SurfaceModel, state: SurfaceState, evidence: SurfaceEvidence) -> tuple[SurfaceState, SurfaceInfo]:
    """Add one more touch or view.

    Args:
        model: What was known before.
        state: What all before say.
        evidence: What this one says.

    Returns:
        The new state, and how well each shape of the library agrees.

    Raises:
        ValueError: What was met lies outside the box that objects are known to be in.
    """
    met = evidence.pad_points if evidence.is_contact else evidence.points
    low, high = model.points.min(0), model.points.max(0)
    if len(met) and not ((met > low) & (met < high)).all(1).any():
        raise ValueError(
            f"a touch or view met something about {np.round(met.mean(0), 3)} m, outside the box of the surface, "
            f"{np.round(low, 3)} to {np.round(high, 3)} m; check its pose and unit, or give a larger box (low, high)"
        )
    found = _log_likelihood(model, evidence)
    bound = np.maximum(state.bound, evidence.region.lower_bound(model.points))
    after = SurfaceState(state.log_weights + found, (*state.evidence, evidence), bound)
    return after, SurfaceInfo(found, _effective(model, after))


def regress(model: SurfaceModel, state: SurfaceState) -> SurfacePosterior:
    """Weigh the library, and regress the remainder on the points of all evidence.

    Args:
        model: What was known before.
        state: What all evidence says.

    Returns:
        A posterior to ask with `predict`.
    """
    prior = weighted_prior(model, state)
    points, values, std = _known_points(model, state, prior)
    posterior = condition_on(model, prior, points=points, values=values, std=std)
    held = [np.zeros(0, int)] * len(state.evidence)
    for _ in range(2):  # where the mean breaks into free space it is held out; then once more
        broken = [_broken(model, posterior, each) for each in state.evidence]
        if not sum(map(len, broken)):
            break
        held = [np.union1d(*rows) for rows in zip(held, broken, strict=True)]
        free = np.concatenate([each.free[rows] for each, rows in zip(state.evidence, held, strict=True)])
        bound = np.concatenate([each.free_bound[rows] for each, rows in zip(state.evidence, held, strict=True)])
        posterior = condition_on(
            model,
            prior,
            points=np.concatenate([points, free]),
            values=np.concatenate([values, bound]),
            std=np.concatenate([std, np.full(len(free), model.config.free_std)]),
        )
    return posterior


def weighted_prior(model: SurfaceModel, state: SurfaceState) -> SurfacePrior:
    """Mean and deviations of the library's shapes by their weights.

    Args:
        model: With the library.
        state: With the weights.

    Returns:
        The prior of the regression, without its stationary part.
    """
    log_w = state.log_weights / model.config.temperature
    count = min(model.config.shapes, len(log_w))
    if not count:
        middle = np.array([0.0, 0.0, 0.5 * (model.points[0, 2] + model.points[-1, 2])])
        ball = np.linalg.norm(model.points - middle, axis=-1) - model.config.radius
        return SurfacePrior(ball.astype(np.float32), np.zeros((len(ball), 0), np.float32))
    weight = np.exp(log_w - logsumexp(log_w))
    pick = likeliest if model.config.likeliest and state.evidence else few_of_many
    shapes, weights = pick(weight, count)
    deviations = model.library.fields(shapes)
    mean = deviations @ weights
    deviations -= mean[:, None]
    deviations *= np.sqrt(weights)
    return SurfacePrior(mean, deviations)


def few_of_many(weight: Float[np.ndarray, " n"], count: int) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """A few weighted shapes that stand for many: those of much weight are kept; of the rest some are drawn, evenly by
    weight and without chance, and share what the kept ones leave (Fearnhead and Clifford, J. R. Statist. Soc. B 65,
    2003). The likeliest alone would not do: after few touches they are thin and small ones, which touches hardly reach.

    Args:
        weight: Of all; sums to 1.
        count: How many stand for them.

    Returns:
        Their indices, and weights that sum to 1.
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


def likeliest(weight: Float[np.ndarray, " n"], count: int) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """The shapes of most weight alone, as `few_of_many` without the others.

    Args:
        weight: Of all; sums to 1.
        count: How many stand for them.

    Returns:
        Their indices, and weights that sum to 1.
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
        model: What was known before.
        prior: By the library's shapes.
        points: m.
        values: m, signed distances at the points.
        std: m, of the values.

    Returns:
        A posterior to ask with `predict`.
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
    """Mean and standard deviation of the signed distance at any points, without carving.

    Args:
        model: Of the posterior.
        posterior: By `regress`.
        points: m; or numbers of points of the model's grid, which is faster.
        spread: Whether standard deviations are wanted, which cost more than means.

    Returns:
        Means and standard deviations (m); zeros in place of the latter where they are not wanted.
    """
    prior, deviations = _prior_at(model, posterior.prior, points)
    matern = _matern(model, model.points[points] if points.ndim == 1 else points, posterior.points)
    if not spread:
        found = matern @ posterior.alpha + deviations @ (posterior.deviations.T @ posterior.alpha)
        return prior + found, np.zeros(len(points))
    cross = matern + deviations @ posterior.deviations.T
    mean = prior + cross @ posterior.alpha
    config = model.config
    variance = np.einsum("qm,qm->q", deviations, deviations) + _residual(model)[0] ** 2
    variance = variance - (_whitened(posterior, cross) ** 2).sum(0)
    return mean, np.hypot(config.band_scale * np.sqrt(np.maximum(variance, 1e-10)), config.band_floor)


def posterior_covariance(
    model: SurfaceModel, posterior: SurfacePosterior, a: Float[np.ndarray, "p 3"], b: Float[np.ndarray, "q 3"]
) -> Float[np.ndarray, "p q"]:
    """Covariance of the signed distance between two sets of points, without the part that no touch reduces
    (`band_floor`).

    Args:
        model: Of the posterior.
        posterior: By `regress`.
        a: m.
        b: m.

    Returns:
        m^2.
    """
    (_, left), (_, right) = (_prior_at(model, posterior.prior, points) for points in (a, b))
    known_a, known_b = (
        _whitened(posterior, _matern(model, points, posterior.points) + deviations @ posterior.deviations.T)
        for points, deviations in ((a, left), (b, right))
    )
    found = left @ right.T + _matern(model, a, b) - known_a.T @ known_b
    return found * model.config.band_scale**2


def estimate_surface(
    model: SurfaceModel, state: SurfaceState, *, stride: int = 1, posterior: SurfacePosterior | None = None
) -> SurfaceEstimate:
    """The signed distance on the grid, with free space carved out of it.

    Args:
        model: What was known before.
        state: What all evidence says.
        stride: Every so many points of the grid along each axis.
        posterior: By `regress`, where it is at hand.

    Returns:
        Its mean and standard deviation.
    """
    numbers = np.arange(len(model.points)).reshape(model.grid.shape)[::stride, ::stride, ::stride]
    grid, rows = VoxelGrid(model.grid.low, model.grid.spacing * stride, numbers.shape), numbers.ravel()
    mean, std = predict(model, posterior or regress(model, state), rows)
    return SurfaceEstimate(grid, np.maximum(mean, state.bound[rows]).astype(np.float32), std.astype(np.float32))


def _student(x: np.ndarray, dof: float) -> np.ndarray:
    """Log density of a Student's t, without its constant."""
    return -0.5 * (dof + 1) * np.log1p(x**2 / dof)


def _log_likelihood(model: SurfaceModel, evidence: SurfaceEvidence) -> np.ndarray:
    """Log likelihood of evidence under each shape of the library, turn after turn."""
    config, total = model.config, []
    every = np.concatenate([evidence.free, evidence.pad_points, evidence.points])
    parts = np.cumsum([len(evidence.free), len(evidence.pad_points)])
    for turn in range(len(TURNS)):
        free, pad, known = np.split(model.library.near(every, turn), parts)
        found = np.zeros(known.shape[1])
        if len(free):
            found += _student(np.minimum(free - evidence.free_bound[:, None], 0).min(0) / config.misfit, config.dof)
        if len(pad):  # also where a reading says more: nothing of the surface lies behind the pad's plane
            found += _student(pad.min(0) / config.misfit, config.dof)
        if len(known):
            scale = np.hypot(config.misfit, evidence.std)[:, None]
            error = (known - evidence.values[:, None]) / scale
            found += evidence.observations * _student(error, config.dof).mean(0)
        total.append(found)
    return np.concatenate(total)


def _effective(model: SurfaceModel, state: SurfaceState) -> float:
    if not len(state.log_weights):
        return 0.0
    log_w = state.log_weights / model.config.temperature
    return float(np.exp(2 * logsumexp(log_w) - logsumexp(2 * log_w)))


def _residual(model: SurfaceModel) -> tuple[float, float]:
    """Standard deviation and length (m) of the stationary part."""
    config = model.config
    return (config.residual, config.length) if model.library.size else (config.smooth_residual, config.smooth_length)


def _matern(model: SurfaceModel, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Matern 5/2 covariance of the part that is not in the library."""
    std, length = _residual(model)
    a, b = (np.asarray(each, np.float32) * np.float32(np.sqrt(5) / length) for each in (a, b))
    square = np.maximum(a @ (-2 * b.T) + (a**2).sum(-1)[:, None] + (b**2).sum(-1), 0)
    r = np.sqrt(square)
    return (square * np.float32(1 / 3) + r + 1) * np.exp(-r) * np.float32(std**2)


def _prior_at(model: SurfaceModel, prior: SurfacePrior, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and deviations at points, or at numbers of points of the grid."""
    if points.ndim == 1:
        return prior.mean[points], prior.deviations[points]
    index, weight = corners_of(model.grid, points)
    return (prior.mean[index] * weight).sum(1), np.einsum("ncm,nc->nm", prior.deviations[index], weight)


def _whitened(posterior: SurfacePosterior, cross: np.ndarray) -> np.ndarray:
    """Covariances (n, q) with the points regressed on, whitened by theirs."""
    if not len(posterior.points):
        return np.zeros((0, len(cross)), np.float32)
    return solve_triangular(posterior.factor, cross.T, lower=True, check_finite=False)


def _known_points(
    model: SurfaceModel, state: SurfaceState, prior: SurfacePrior
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, signed distances and deviations of all evidence; of a square of which no more is known the point where
    the surface is expected to be nearest.
    """
    config = model.config
    points, values, std = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0)]
    for each in state.evidence:
        if not len(each.points) and each.is_contact:
            each = _with_guess(model, prior, each)
        points.append(each.points)
        values.append(each.values)
        std.append(np.hypot(each.std, config.pose_std))
    return np.concatenate(points), np.concatenate(values), np.concatenate(std)


def _with_guess(model: SurfaceModel, prior: SurfacePrior, touch: SurfaceEvidence) -> SurfaceEvidence:
    """A touch that does not know where its pad met the surface, with the point where the shapes expect it."""
    assert isinstance(touch.region, Sweep)
    nearest = touch.pad_points[[int(_prior_at(model, prior, touch.pad_points)[0].argmin())]]
    local = (nearest - touch.region.T_o_t[:3, 3]) @ touch.region.T_o_t[:3, :3]
    return with_surface_points(touch, local, np.array([model.config.contact_std]))


def _broken(model: SurfaceModel, posterior: SurfacePosterior, evidence: SurfaceEvidence) -> Int[np.ndarray, " r"]:
    """Rows of the free points that the mean violates most: a few of each touch or view."""
    excess = predict(model, posterior, evidence.free, spread=False)[0] - evidence.free_bound
    worst = np.argsort(excess)[: model.config.free_points]
    return worst[excess[worst] < -model.config.free_tolerance]
