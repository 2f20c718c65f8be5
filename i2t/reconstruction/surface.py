"""An unknown object's surface from a few touches, with the uncertainty of every part of it.

The surface is where a signed distance f (m, negative inside) is zero. Before the first touch f is a Gaussian process
whose mean and covariance are those of a library of other shapes, plus a stationary part for what the library does not
hold; a library of none leaves a prior of smoothness alone, around a ball.

    f = sum_k w_k f_k + residual,   cov = a sum_k w_k (f_k - m)(f_k - m)' + s^2 Matern_{5/2}(r / l)

A touch says four things, all in the frame of the object:
  - what the pad swept on its way is free, and stays so exactly (carving): f >= distance to the rim of what was swept;
  - where it stopped, the lowest point of the surface in the pad's square lies on the plane of the pad;
  - what its reading says of the surface in front of the pad, if anything: heights with their
    standard deviations, and how far beyond the plane space is known to be free;
  - a touch that met nothing sweeps its whole way, and says no more.
The library's weights follow from how well each shape agrees (a Student's t likelihood, tempered, since a touch's
points are not independent), and what is left is a linear regression on the points, with points of free space where
the mean would break in. The inverse of `i2t.simulation.sites.press_along`; frames as in `i2t.types`, O the object.

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
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.special import logsumexp

from i2t.errors import require_extra
from i2t.objects.solids import Mesh
from i2t.reconstruction.signed_distances import (
    VoxelGrid,
    corners_of,
    extract_mesh,
    grid_around,
    interpolate,
    signed_distance_grid,
)
from i2t.types import Array
from i2t.windows import PAD_WINDOW, PATCH_WINDOW, REACH, STANDOFF

QUARTERS = 4  # turns of a shape about z that the library holds
LATTICE = 5  # heights of a touch along each edge of the patch's window
RIM = 7  # points of the pad's square along each edge, among which the lowest is sought
SWEPT_DEPTHS_M = (0.5e-3, 3e-3, 8e-3, 16e-3, 28e-3)  # behind the pad's plane, where space is looked at
Z_90 = 1.645  # standard deviations of a band of 90 %
CORRELATION_FACTOR = 1.5  # factor on the standard deviations of a posterior's heights
LEAST_STD_M = 0.2e-3  # of a height
FREE_STRIDE = 2  # of the grid on which the mean is compared with free space


@dataclass(frozen=True)
class SurfaceConfig:
    """Assumptions on shapes and touches."""

    across: int = 36  # points of the grid along x and along y
    margin: float = 8e-3  # m, of the grid around the shapes
    shapes: int = 128  # of the library that have most weight; the rest is left out
    temperature: float = 2.0  # by which log likelihoods of shapes are divided
    misfit: float = 3e-3  # m, by which a known shape may miss an unknown object and still be like it
    dof: float = 4.0  # of the Student's t of that misfit
    library_share: float = 1.0  # a, of the library's covariance
    residual: float = 3e-3  # m, standard deviation s of what no shape of the library has
    length: float = 12e-3  # m, of its correlation
    smooth_residual: float = 15e-3  # m, the same where there is no library
    smooth_length: float = 25e-3  # m
    radius: float = 30e-3  # m, of the ball that stands for a library of none
    useful_std: float = 2.5e-3  # m, of a height; one that is less certain says too little for its cost
    pose_std: float = 1e-3  # m, of a point of contact, from what the tool's pose is uncertain by
    contact_std: float = 2e-3  # m, more, where the point of contact in the pad's square is a guess
    inside_depth: float = 3e-3  # m behind a contact where the object is expected to be solid
    inside_std: float = 2e-3  # m
    free_tolerance: float = 0.5e-3  # m by which the mean may break into free space
    free_std: float = 1e-3  # m
    free_points: int = 4  # of a touch, at most, that hold the mean out of free space
    band_scale: float = 1.0  # of all standard deviations, chosen on other objects
    band_floor: float = 1e-3  # m, standard deviation that no touch takes away: placement, and what the grid cannot hold


class SurfaceModel(NamedTuple):
    """Prior knowledge of the surface."""

    grid: VoxelGrid
    points: Float[np.ndarray, "g 3"]  # m, of the grid
    library: Float[np.ndarray, "g k"]  # m, signed distances of known shapes, as float16; k is 0 where there are none
    config: SurfaceConfig


class TouchEvidence(NamedTuple):
    """Evidence of one touch on the surface, in the frame of the pad that made it."""

    T_o_t: Float[np.ndarray, "4 4"]  # pose of the tool at first contact, or where the way through air ended
    hit: bool  # whether there was a contact
    swept: float  # m of the straight way behind that pose
    height: Float[np.ndarray, "5 5"]  # m, of the surface beyond the pad's plane on a lattice over the patch's window
    std: Float[np.ndarray, "5 5"]  # m, of each height; inf where nothing is known of it
    free: Float[np.ndarray, "5 5"]  # m beyond the plane that are known to be free


class SurfaceState(NamedTuple):
    """Evidence of all touches."""

    log_weights: Float[np.ndarray, " k"]  # of the library's shapes, not normalised, not tempered
    touches: tuple[TouchEvidence, ...]


class SurfaceInfo(NamedTuple):
    """Result of an update."""

    log_likelihood: Float[np.ndarray, " k"]  # of the touch under each shape of the library
    effective_shapes: float  # as many equal weights would be as spread


class SurfaceEstimate(NamedTuple):
    """A signed distance on the grid, with its spread."""

    grid: VoxelGrid
    distance: Float[np.ndarray, " g"]  # m
    std: Float[np.ndarray, " g"]  # m

    @property
    def mesh(self) -> Mesh:
        """The surface in metres, in the object's frame; needs scikit-image."""
        return extract_mesh(self.grid, self.distance)


class SurfacePosterior(NamedTuple):
    """The regression on a state's points, to be evaluated anywhere."""

    weights: Float[np.ndarray, " m"]  # of the shapes that count
    shapes: Int[np.ndarray, " m"]  # which of the library
    points: Float[np.ndarray, "n 3"]  # m, that were regressed on
    deviations: Float[np.ndarray, "n m"]  # of the shapes from their mean at them, times the root of their weights
    factor: tuple[np.ndarray, bool]  # Cholesky factor of their covariance
    residual: Float[np.ndarray, " n"]  # m, solved by that factor


def surface_model(
    meshes: Sequence[Mesh],
    *,
    config: SurfaceConfig | None = None,
    low: Array = (-40e-3, -40e-3, 0.0),
    high: Array = (40e-3, 40e-3, 50e-3),
) -> SurfaceModel:
    """A model whose library are the given shapes, each in four quarter turns about z.

    Args:
        meshes: Closed meshes that stand where objects stand; none for a prior of smoothness alone.
        config: What is assumed.
        low: (3,) m, lowest corner of the box that objects are known to be in; shapes may enlarge it.
        high: (3,) m, its highest corner.

    Returns:
        The model.

    Raises:
        MissingExtraError: scikit-image is missing, which makes the surface in the end.
    """
    require_extra("skimage", "a mesh of signed distances")  # here, and not after all touches
    config = config or SurfaceConfig()
    bounds = [np.asarray(low, float), *(mesh.vertices.min(0) for mesh in meshes)]
    tops = [np.asarray(high, float), *(mesh.vertices.max(0) for mesh in meshes)]
    grid = grid_around(np.min(bounds, 0), np.max(tops, 0), across=config.across, margin=config.margin)
    points = grid.points()
    library = np.zeros((len(points), QUARTERS * len(meshes)), np.float16)
    for i, mesh in enumerate(meshes):
        field = signed_distance_grid(mesh, grid).reshape(grid.shape)
        for turn in range(QUARTERS):
            library[:, QUARTERS * i + turn] = np.rot90(field, turn, axes=(0, 1)).ravel()
    return SurfaceModel(grid, points, library, config)


def init(model: SurfaceModel) -> tuple[SurfaceState, SurfaceInfo]:
    """State before the first touch.

    Args:
        model: What is known.

    Returns:
        The state, and what it holds.
    """
    shapes = model.library.shape[1]
    return SurfaceState(np.zeros(shapes), ()), SurfaceInfo(np.zeros(shapes), float(shapes))


def update(model: SurfaceModel, state: SurfaceState, evidence: TouchEvidence) -> tuple[SurfaceState, SurfaceInfo]:
    """Add one more touch.

    Args:
        model: What was known before.
        state: What the touches before say.
        evidence: What this one says.

    Returns:
        The new state, and how well each shape of the library agrees with the touch.
    """
    found = _log_likelihood(model, evidence)
    after = state._replace(log_weights=state.log_weights + found, touches=(*state.touches, evidence))
    return after, SurfaceInfo(found, _effective(model, after))


def contact_evidence(T_o_t: Float[Array, "4 4"], *, hit: bool = True, swept: float = STANDOFF) -> TouchEvidence:
    """Evidence of a touch of which nothing is known but the pose of contact.

    Args:
        T_o_t: Pose of the tool at first contact, or where the way through air ended.
        hit: Whether there was a contact.
        swept: m of the straight way behind that pose.

    Returns:
        The evidence: no height, and nothing free beyond the pad's plane.
    """
    nothing = np.zeros((LATTICE, LATTICE))
    return TouchEvidence(np.asarray(T_o_t, np.float64), bool(hit), float(swept), nothing, nothing + np.inf, nothing)


def posterior_evidence(
    T_o_t: Float[Array, "4 4"], patches: Float[Array, "k p p"], *, swept: float = STANDOFF
) -> TouchEvidence:
    """Evidence of a touch whose reading left a posterior over the surface before the pad.

    Args:
        T_o_t: Pose of the tool at first contact.
        patches: m beyond the plane of first contact, samples alike in weight (`PatchPosterior.patch`).
        swept: m of the straight way behind that pose.

    Returns:
        Means and standard deviations of the heights; what nearly all samples leave free; nothing of heights that may
        lie beyond the patch's reach.
    """
    place = ((np.arange(LATTICE) + 0.5) / LATTICE * np.shape(patches)[-1]).astype(int)
    samples = np.asarray(patches)[:, place][:, :, place].astype(np.float64)
    mean, low, high = samples.mean(0), np.quantile(samples, 0.05, 0), np.quantile(samples, 0.9, 0)
    # Errors of neighbouring heights come together, so each counts for less than its spread says.
    std = np.where(high < 0.95 * REACH, CORRELATION_FACTOR * samples.std(0) + LEAST_STD_M, np.inf)
    return contact_evidence(T_o_t, swept=swept)._replace(height=mean, std=std, free=0.8 * low)


def regress(model: SurfaceModel, state: SurfaceState) -> SurfacePosterior:
    """Weigh the library, and regress the remainder on the points of all touches.

    Args:
        model: What was known before.
        state: What the touches say.

    Returns:
        A posterior to ask with `predict`.
    """
    shapes, weights = _counted(model, state)
    points, values, std = _surface_points(model, state, shapes, weights)
    free, bound = free_points(state)
    posterior = condition_on(model, shapes, weights, points=points, values=values, std=std)
    grid, rows = coarse_grid(model, FREE_STRIDE)
    for _ in range(2 if len(free) else 0):  # where the mean breaks into free space it is held out; then once more
        mean, _ = predict(model, posterior, rows, spread=False)
        worst = _worst(interpolate(grid, mean, free) - bound, len(state.touches), model.config)
        if not len(worst):
            break
        points = np.concatenate([points, free[worst]])
        values = np.concatenate([values, bound[worst]])
        std = np.concatenate([std, np.full(len(worst), model.config.free_std)])
        posterior = condition_on(model, shapes, weights, points=points, values=values, std=std)
    return posterior


def condition_on(
    model: SurfaceModel,
    shapes: Int[np.ndarray, " m"],
    weights: Float[np.ndarray, " m"],
    *,
    points: Float[np.ndarray, "n 3"],
    values: Float[np.ndarray, " n"],
    std: Float[np.ndarray, " n"],
) -> SurfacePosterior:
    """Regress the signed distance on its values at some points.

    Args:
        model: What was known before.
        shapes: Those of the library that count.
        weights: Of these shapes.
        points: m.
        values: m, signed distances at the points.
        std: m, of the values.

    Returns:
        A posterior to ask with `predict`.
    """
    prior, deviations = _prior_at(model, shapes, weights, points)
    cov = model.config.library_share * deviations @ deviations.T + _matern(model, points, points)
    cov = cov.astype(np.float64) + np.diag(std**2 + 1e-9)
    factor = cho_factor(cov, lower=True, check_finite=False) if len(points) else (np.zeros((0, 0)), True)
    residual = cho_solve(factor, values - prior, check_finite=False) if len(points) else np.zeros(0)
    narrow = factor[0].astype(np.float32), True
    return SurfacePosterior(weights, shapes, points, deviations, narrow, residual.astype(np.float32))


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
    prior, deviations, cross = _prior_and_cross(model, posterior, points)
    mean = prior + cross @ posterior.residual
    if not spread:
        return mean, np.zeros(len(points))
    variance = _prior_variance(model, deviations)
    if len(posterior.points):
        variance = variance - (_whitened(posterior, cross) ** 2).sum(0)
    config = model.config
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
    _, left, cross_a = _prior_and_cross(model, posterior, a)
    _, right, cross_b = _prior_and_cross(model, posterior, b)
    found = model.config.library_share * left @ right.T + _matern(model, a, b)
    if len(posterior.points):
        found = found - _whitened(posterior, cross_a).T @ _whitened(posterior, cross_b)
    return found * model.config.band_scale**2


def estimate_surface(
    model: SurfaceModel, state: SurfaceState, *, stride: int = 1, posterior: SurfacePosterior | None = None
) -> SurfaceEstimate:
    """The signed distance on the grid, carved by the swept volume.

    Args:
        model: What was known before.
        state: What the touches say.
        stride: Every so many points of the grid along each axis.
        posterior: By `regress`, where it is at hand.

    Returns:
        Its mean and standard deviation.
    """
    grid, rows = coarse_grid(model, stride)
    mean, std = predict(model, posterior or regress(model, state), rows)
    bound = swept_distance(state, model.points[rows])
    return SurfaceEstimate(grid, np.maximum(mean, bound).astype(np.float32), std.astype(np.float32))


def coarse_grid(model: SurfaceModel, stride: int) -> tuple[VoxelGrid, Int[np.ndarray, " q"]]:
    """Every `stride`-th point of the model's grid along each axis.

    Args:
        model: With its grid.
        stride: 1 takes all.

    Returns:
        The coarser grid, and which points of the model's grid its points are.
    """
    number = np.arange(len(model.points)).reshape(model.grid.shape)[::stride, ::stride, ::stride]
    return VoxelGrid(model.grid.low, model.grid.spacing * stride, number.shape), number.ravel()


def swept_distance(state: SurfaceState, points: Float[np.ndarray, "q 3"]) -> Float[np.ndarray, " q"]:
    """Depth of each point in the pads' swept volume: no surface is nearer to it.

    Args:
        state: With its touches.
        points: m.

    Returns:
        m; -inf for points that no pad swept.
    """
    found = np.full(len(points), -np.inf)
    for touch in state.touches:
        x, y, z = ((points - touch.T_o_t[:3, 3]) @ touch.T_o_t[:3, :3]).T
        half = PAD_WINDOW / 2
        depth = np.minimum(np.minimum(half - np.abs(x), half - np.abs(y)), np.minimum(-z, z + touch.swept))
        found = np.where(depth > 0, np.maximum(found, depth), found)
    return found


def free_points(state: SurfaceState) -> tuple[Float[np.ndarray, "q 3"], Float[np.ndarray, " q"]]:
    """Free points, and lower bounds of their signed distance, touch after touch.

    Args:
        state: With its touches.

    Returns:
        Points and distances (m).
    """
    edge = (np.arange(5) / 4 - 0.5) * 0.9 * PAD_WINDOW
    x, y, z = (each.ravel() for each in np.meshgrid(edge, edge, -np.array(SWEPT_DEPTHS_M), indexing="ij"))
    bound = np.minimum(PAD_WINDOW / 2 - np.maximum(np.abs(x), np.abs(y)), -z)
    places, bounds = [np.zeros((0, 3))], [np.zeros(0)]
    for touch in state.touches:
        X, Y = _lattice()
        local = np.concatenate([np.stack([x, y, z], -1), np.stack([X, Y, touch.free.ravel()], -1)])
        places.append(_to_object(touch, local))
        bounds.append(np.concatenate([bound, np.zeros(X.size)]))
    return np.concatenate(places), np.concatenate(bounds)


def _lattice() -> tuple[np.ndarray, np.ndarray]:
    """x and y of the lattice over the patch's window; row i along y."""
    centres = ((np.arange(LATTICE) + 0.5) / LATTICE - 0.5) * PATCH_WINDOW
    y, x = np.meshgrid(centres, centres, indexing="ij")
    return x.ravel(), y.ravel()


def _to_object(touch: TouchEvidence, local: np.ndarray) -> np.ndarray:
    return local @ touch.T_o_t[:3, :3].T + touch.T_o_t[:3, 3]


def _square(touch: TouchEvidence) -> np.ndarray:
    """Points of the pad's square, in the object's frame."""
    edge = (np.arange(RIM) / (RIM - 1) - 0.5) * PAD_WINDOW
    x, y = (each.ravel() for each in np.meshgrid(edge, edge))
    return _to_object(touch, np.stack([x, y, 0 * x], -1))


def _felt(touch: TouchEvidence) -> tuple[np.ndarray, np.ndarray]:
    """Points of the surface that a touch felt, in the object's frame, and their standard deviations."""
    x, y = _lattice()
    known = np.isfinite(touch.std.ravel())
    local = np.stack([x, y, touch.height.ravel()], -1)[known]
    return _to_object(touch, local), touch.std.ravel()[known]


def _library_at(model: SurfaceModel, points: np.ndarray, shapes: np.ndarray | None = None) -> np.ndarray:
    """Signed distances (points, shapes) of the library."""
    index, weight = corners_of(model.grid, points)
    found = np.zeros((len(points), model.library.shape[1] if shapes is None else len(shapes)), np.float32)
    for corner in range(index.shape[1]):
        rows = index[:, corner] if shapes is None else (index[:, corner, None], shapes)
        found += model.library[rows].astype(np.float32) * weight[:, corner, None]
    return found


def _student(x: np.ndarray, dof: float) -> np.ndarray:
    """Log density of a Student's t, without its constant."""
    return -0.5 * (dof + 1) * np.log1p(x**2 / dof)


def _log_likelihood(model: SurfaceModel, touch: TouchEvidence) -> np.ndarray:
    """Log likelihood of a touch under each shape of the library."""
    config = model.config
    if not model.library.shape[1]:
        return np.zeros(0)
    free, bound = free_points(SurfaceState(np.zeros(0), (touch,)))
    broken = np.minimum(_library_at(model, free) - bound[:, None], 0).min(0)
    total = _student(broken / config.misfit, config.dof)
    if touch.hit:
        total = total + _student(_library_at(model, _square(touch)).min(0) / config.misfit, config.dof)
        points, std = _felt(touch)
        if len(points):
            scale = np.hypot(config.misfit, std)[:, None]
            total = total + _student(_library_at(model, points) / scale, config.dof).mean(0)
    return total


def _effective(model: SurfaceModel, state: SurfaceState) -> float:
    if not len(state.log_weights):
        return 0.0
    log_w = state.log_weights / model.config.temperature
    return float(np.exp(2 * logsumexp(log_w) - logsumexp(2 * log_w)))


def _counted(model: SurfaceModel, state: SurfaceState) -> tuple[np.ndarray, np.ndarray]:
    """The shapes that have most weight, and their weights."""
    log_w = state.log_weights / model.config.temperature
    count = min(model.config.shapes, len(log_w))
    if count == len(log_w):
        shapes = np.arange(count)
    elif not state.touches:
        shapes = np.linspace(0, len(log_w) - 1, count).astype(int)
    else:
        shapes = np.argpartition(-log_w, count)[:count]
    weights = np.exp(log_w[shapes] - logsumexp(log_w[shapes])) if count else np.zeros(0)
    return shapes, weights


def _prior_at(
    model: SurfaceModel, shapes: np.ndarray, weights: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the weighted shapes at points, and their deviations times the root of their weights."""
    if not len(shapes):
        points = model.points[points] if points.ndim == 1 else points
        middle = np.array([0.0, 0.0, 0.5 * (model.points[0, 2] + model.points[-1, 2])])
        return np.linalg.norm(points - middle, axis=-1) - model.config.radius, np.zeros((len(points), 0))
    if points.ndim == 1:
        values = model.library[points[:, None], shapes].astype(np.float32)
    else:
        values = _library_at(model, points, shapes)
    mean = values @ weights.astype(np.float32)
    return mean, (values - mean[:, None]) * np.sqrt(weights).astype(np.float32)


def _matern(model: SurfaceModel, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Matern 5/2 covariance of the part that is not in the library."""
    config = model.config
    known = model.library.shape[1] > 0
    std, length = (config.residual, config.length) if known else (config.smooth_residual, config.smooth_length)
    a, b = (np.asarray(each, np.float32) * np.float32(np.sqrt(5) / length) for each in (a, b))
    square = np.maximum(a @ (-2 * b.T) + (a**2).sum(-1)[:, None] + (b**2).sum(-1), 0)
    r = np.sqrt(square)
    return (square * np.float32(1 / 3) + r + 1) * np.exp(-r) * np.float32(std**2)


def _prior_and_cross(
    model: SurfaceModel, posterior: SurfacePosterior, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Prior mean at points, deviations of the shapes there, and covariance with the points regressed on."""
    prior, deviations = _prior_at(model, posterior.shapes, posterior.weights, points)
    cross = _matern(model, model.points[points] if points.ndim == 1 else points, posterior.points)
    if deviations.shape[1]:
        cross += model.config.library_share * deviations @ posterior.deviations.T.astype(np.float32)
    return prior, deviations, cross


def _prior_variance(model: SurfaceModel, deviations: np.ndarray) -> np.ndarray:
    config = model.config
    own = config.residual if model.library.shape[1] else config.smooth_residual
    return config.library_share * (deviations**2).sum(-1) + own**2


def _whitened(posterior: SurfacePosterior, cross: np.ndarray) -> np.ndarray:
    """Covariances (n, q) with the points regressed on, whitened by theirs."""
    return solve_triangular(posterior.factor[0], cross.T, lower=True, check_finite=False)


def _surface_points(
    model: SurfaceModel, state: SurfaceState, shapes: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points that contacts put on the surface or behind it, their signed distances and deviations."""
    config = model.config
    points, values, std = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0)]
    for touch in state.touches:
        if not touch.hit:
            continue
        on, spread = _felt(touch)
        on, spread = on[spread < config.useful_std], spread[spread < config.useful_std]
        spread = np.hypot(spread, config.pose_std)
        if not len(on):  # nothing is known of where in its square the pad met the surface: where it is expected
            square = _square(touch)
            expected = _prior_at(model, shapes, weights, square)[0]
            on = square[[int(expected.argmin())]]
            spread = np.array([np.hypot(config.pose_std, config.contact_std)])
        behind = on[[int(spread.argmin())]] + config.inside_depth * touch.T_o_t[:3, 2]
        points += [on, behind]
        values += [np.zeros(len(on)), np.array([-config.inside_depth])]
        std += [spread, np.array([config.inside_std])]
    return np.concatenate(points), np.concatenate(values), np.concatenate(std)


def _worst(excess: np.ndarray, touches: int, config: SurfaceConfig) -> np.ndarray:
    """The free points that the mean violates most: a few of each touch."""
    chosen: list[np.ndarray] = []
    for rows in np.array_split(np.arange(len(excess)), touches):
        worst = rows[np.argsort(excess[rows])[: config.free_points]]
        chosen.append(worst[excess[worst] < -config.free_tolerance])
    return np.concatenate(chosen)
