"""Local shape from one press: a posterior over patches of a library.

A library holds patches of many shapes (`i2t.reconstruction.library`), a `PressModel` what one pad would read at each
of them under a few loads. A press is one or more stops, each with a reading (uT), a force (N) and a travel past first
contact (m); two stops of one press, at 25 and at 100 uT say, are a press curve. Each patch i of the library is weighted
by how well it explains all of the press,

    y = r_i(F) + (U_i a + e) / sqrt(g),    a ~ N(0, I),    e ~ N(0, D),    g ~ Gamma(k/2, k/2),

where r_i is interpolated at the measured force and the columns of U_i are nuisances that are integrated out: the slant
of the press along two axes (friction, the same at all its stops), the error of each force, and that of first contact.
So y is of a multivariate Student's t with k degrees of freedom. With z = D^-1/2 (y - r_i), V = D^-1/2 U_i and
A = I + V'V,

    log w_i = 1 / (T S) [ -1/2 log |A| - (k + m)/2 log(1 + (z'z - z'V A^-1 V'z) / k) ]

with m measured values at S stops, and T a temperature: patches are not the truth, and what a model errs is alike in all
channels. A share of the prior stays mixed in, so that no touch is certain. Posterior samples are drawn from the weights
systematically and are alike in weight.

Frames and units as in `i2t.types`. A patch is what lies in front of the skin at first contact: metres along tool z
beyond the plane of first contact, clipped to the reach. Pure functions on one press; compile them at the edge:

    infer = jax.jit(infer_patch, static_argnames=("samples",))
    posterior = infer(reading, force, travel, model=model, library=library)
"""

from functools import reduce
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from i2t import validation
from i2t.patches.dimensions import CONTACT_TOLERANCE_M, PAD_WINDOW, PATCH_WINDOW
from i2t.skin.contact import cells_in_contact

SAMPLES = 256
SMALLEST_FORCE_N = 0.02  # a noisy wrench sensor says less


class PatchLibrary(NamedTuple):
    """Patches of many shapes, and their presses by a pad of nominal stiffness; the same for every pad."""

    patch: Float[Any, "n p p"]  # m beyond the plane of first contact, clipped to the reach
    height: Float[Any, "n g g"]  # m, the same over the cells of the pad, uncut (+inf where there is no surface)
    object: Int[Any, " n"]  # which shape each is from
    loads: Float[Any, " l"]  # N, ascending
    newtons: Float[Any, "n l cells"]  # on each cell of 1 mm, row along tool y
    indentation: Float[Any, "n l"]  # m past first contact, of the nominal layer
    centre: Float[Any, "n l 2"]  # m, centre of pressure (x, y)


class PatchLikelihood(NamedTuple):
    """Errors of a press about the predicted one; near what `experiments.reconstruct patch` chooses on validation
    objects.
    """

    slant_std: Float[Array, ""] | float = 0.01745  # m/m, of the press's motion along x and y (1 degree)
    force_std: Float[Array, ""] | float = 0.1  # N, of each stop
    travel_std: Float[Array, ""] | float = 0.07e-3  # m, of each stop
    contact_std: Float[Array, ""] | float = 0.1e-3  # m, of first contact, the same at all stops of a press
    relative_error: Float[Array, ""] | float = 0.1  # of the reading's norm, by which imagined readings err
    dof: Float[Array, ""] | float = 6.0  # of Student's t
    temperature: Float[Array, ""] | float = 2.0  # T, times the number of stops, whose errors are alike
    prior_share: Float[Array, ""] | float = 0.02  # of the prior in the weights
    blur: Float[Array, ""] | float = 1.0  # pixels, by which probabilities of masks are smoothed


class PressModel(NamedTuple):
    """Readings of one pad at each patch of a library under each of its loads.

    Readings are turned to the axes in which the sensor's noise is independent; those axes come first in memory, and
    patches last, as every touch needs all of them.
    """

    loads: Float[Array, " l"]  # N
    reading: Float[Array, "l c n"]  # uT
    sliding: Float[Array, "l 2 c n"]  # uT for a slant of 1 m/m along x and y
    travel: Float[Array, "l n"]  # m past first contact, with what arm and mount yield
    axes: Float[Array, "c c"]  # turns a reading to those axes: axes @ reading
    noise: Float[Array, " c"]  # uT^2, variance along each axis
    likelihood: PatchLikelihood


class PatchPosterior(NamedTuple):
    """Posterior over patches. Samples (k) are alike in weight; `weight` is of every patch of the library."""

    weight: Float[Array, " n"]  # of the library's patches; sums to 1
    rows: Int[Array, " k"]  # of the samples in the library
    patch: Float[Array, "k p p"]  # m beyond the plane of first contact
    mean: Float[Array, "p p"]  # m
    mask_probability: Float[Array, "p p"]  # of a surface within 1.5 mm of that plane (the paper's mask)
    contact_probability: Float[Array, "g g"]  # of pressure on each cell of 1 mm, at the load nearest the last stop's
    centre: Float[Array, "2"]  # m, centre of pressure (x, y) at that load
    centre_covariance: Float[Array, "2 2"]  # m^2


def infer_patch(
    reading: Float[Array | np.ndarray, "*s c"],
    force: Float[Array | np.ndarray, "*s"] | float,
    travel: Float[Array | np.ndarray, "*s"] | float = jnp.nan,
    *,
    model: PressModel,
    library: PatchLibrary,
    samples: int = SAMPLES,
) -> PatchPosterior:
    """The posterior over local surfaces after one press.

    Args:
        reading: uT, at the one stop of a press (c,) or at several (s, c), in the board's order and axes; a stop with
            a value that is not finite, or of unknown force, counts as not made.
        force: N, at each.
        travel: m past first contact, at each; NaN where it was not measured.
        model: What the pad reads at the library's patches.
        library: The patches.
        samples: How many are drawn; static.

    Returns:
        The posterior.

    Raises:
        ValueError: A force is more than a skin bears.

    Example:
        infer = jax.jit(infer_patch, static_argnames=("samples",))
        posterior = infer(touch.reading, touch.force, touch.depth, model=model, library=library)
        posterior.mean, posterior.mask_probability, jnp.quantile(posterior.patch, 0.9, axis=0)
    """
    if not validation.is_traced(force):
        forces = np.asarray(force, float)
        validation.forces("force", forces[np.isfinite(forces)], measured=True)
    reading = jnp.atleast_2d(jnp.asarray(reading))
    force = jnp.atleast_1d(jnp.asarray(force, reading.dtype))
    made = jnp.all(jnp.isfinite(reading), axis=1) & jnp.isfinite(force)
    reading = jnp.where(made[:, None], reading, jnp.nan)
    force = jnp.maximum(jnp.where(made, force, 0.0), SMALLEST_FORCE_N)
    travel = jnp.broadcast_to(jnp.asarray(travel, reading.dtype), force.shape)
    last = force[jnp.max(jnp.where(made, jnp.arange(len(force)), 0))]
    if len(reading) == 1:  # a loop of one step is none to the compiler, see `log_likelihood`
        reading = jnp.concatenate([reading, jnp.full_like(reading, jnp.nan)])
        force, travel = jnp.tile(force, 2), jnp.tile(travel, 2)
    judged = log_likelihood(reading, force, travel, model=model)
    weight = posterior_weights(judged, model.likelihood, jnp.sum(made))
    return summarize(weight, last, library=library, blur=model.likelihood.blur, samples=samples)


def log_likelihood(
    reading: Float[Array, "s c"], force: Float[Array, " s"], travel: Float[Array, " s"], *, model: PressModel
) -> Float[Array, " n"]:
    """Log likelihood of a press under each patch of the library, up to a constant.

    Args:
        reading: uT, at each stop; one with a NaN counts as not made.
        force: N, at each, above 0.
        travel: m past first contact; NaN where it was not measured.
        model: What the pad reads at the library's patches.

    Returns:
        Logarithms of the likelihood, neither tempered nor normalised.
    """
    what = model.likelihood
    made = jnp.all(jnp.isfinite(reading), axis=1)
    turned = jnp.where(made[:, None], reading, 0) @ model.axes.T

    def compare(stop: tuple[Array, Array, Array, Array]) -> _Differences:
        reading, force, travel, made = stop
        error = what.relative_error**2 * jnp.mean(reading**2)
        scale = made / jnp.sqrt(model.noise + error)[:, None]
        at, slope = _at_force(model.reading, model.loads, force)
        known = (made & jnp.isfinite(travel)) / what.travel_std
        travelled, travel_slope = _at_force(model.travel, model.loads, force, proportional=False)
        return _Differences(
            reading=scale * (reading[:, None] - at),
            travel=known * (jnp.where(known > 0, travel, 0) - travelled),
            sliding=what.slant_std * scale[None] * _at_force(model.sliding, model.loads, force)[0],
            by_force=what.force_std * scale * slope,
            travel_by_force=known * what.force_std * travel_slope,
            contact=known * what.contact_std,
        )

    # One stop after the other: fused with what follows, each sum there would interpolate again.
    distance, log_det = _marginal(jax.lax.map(compare, (turned, force, travel, made)))
    measured = jnp.sum(made * (reading.shape[1] + jnp.isfinite(travel)))
    return -0.5 * log_det - 0.5 * (what.dof + measured) * jnp.log1p(distance / what.dof)


def posterior_weights(
    log_likelihood: Float[Array, " n"], likelihood: PatchLikelihood, stops: Int[Array, ""] | int = 1
) -> Float[Array, " n"]:
    """Weights of the library's patches, tempered, with a share of the prior.

    Args:
        log_likelihood: Of each.
        likelihood: Says temperature and share.
        stops: Number of stops of the press.

    Returns:
        Weights that sum to 1.
    """
    weight = jax.nn.softmax(log_likelihood / (likelihood.temperature * jnp.maximum(stops, 1)))
    return (1 - likelihood.prior_share) * weight + likelihood.prior_share / len(weight)


def summarize(
    weight: Float[Array, " n"],
    force: Float[Array, ""],
    *,
    library: PatchLibrary,
    blur: Float[Array, ""] | float = 0.0,
    samples: int = SAMPLES,
) -> PatchPosterior:
    """Posterior of the surface by weights of the patches.

    Args:
        weight: Of the patches; sums to 1.
        force: N, of the last stop, to whose load contacts belong.
        library: The patches.
        blur: Pixels, by which probabilities of masks are smoothed.
        samples: How many are drawn; static.

    Returns:
        The posterior.
    """
    library = jax.tree.map(jnp.asarray, library)
    rows = systematic_samples(weight, samples)
    patch = library.patch[rows]
    load = jnp.argmin(jnp.abs(jnp.log(library.loads) - jnp.log(force)))
    cells = round(library.newtons.shape[-1] ** 0.5)
    pressed = cells_in_contact(library.newtons[rows, load])
    centre = library.centre[rows, load]
    middle = jnp.mean(centre, axis=0)
    about = centre - middle[None]
    mask = jnp.mean(patch <= CONTACT_TOLERANCE_M, axis=0, dtype=jnp.float32)
    contact = jnp.mean(pressed, axis=0, dtype=jnp.float32).reshape(cells, cells)
    return PatchPosterior(
        weight=weight,
        rows=rows,
        patch=patch,
        mean=jnp.mean(patch, axis=0, dtype=jnp.float32),
        mask_probability=_blurred(mask, blur),
        contact_probability=_blurred(contact, blur * cells / PAD_WINDOW * PATCH_WINDOW / patch.shape[-1]),
        centre=middle,
        centre_covariance=about.T @ about / samples,
    )


def systematic_samples(weight: Float[Array, " n"], samples: int) -> Int[Array, " k"]:
    """Indices drawn in proportion to weights, as evenly as can be (Kitagawa, J. Comput. Graph. Stat. 5, 1996), without
    chance.

    Args:
        weight: Sums to 1.
        samples: How many; static.

    Returns:
        Ascending indices; where a weight is large, the same one often.
    """
    total = jnp.cumsum(weight)
    wanted = (jnp.arange(samples) + 0.5) / samples * total[-1]
    return jnp.minimum(jnp.searchsorted(total, wanted), len(weight) - 1)


class _Differences(NamedTuple):
    """Differences of a press from each predicted one, and effects of nuisances, all in standard deviations."""

    reading: Float[Array, "s c n"]
    travel: Float[Array, "s n"]
    sliding: Float[Array, "s 2 c n"]  # readings, for a slant of one standard deviation
    by_force: Float[Array, "s c n"]  # readings, for an error of the force
    travel_by_force: Float[Array, "s n"]
    contact: Float[Array, " s"]  # travel, for an error of first contact


def _at_force(
    curves: Array, loads: Array, force: Array, *, proportional: bool = True
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Curves over loads (l, ...) at a force, and their derivative by it: linear in the logarithm of the load,
    proportional ones as values per newton; at most one step beyond the outer loads.
    """
    knots = jnp.log(loads)
    low = jnp.clip(jnp.searchsorted(knots, jnp.log(force)) - 1, 0, len(loads) - 2)
    gap = knots[low + 1] - knots[low]
    step = jnp.clip((jnp.log(force) - knots[low]) / gap, -1.0, 2.0)
    first = jax.lax.dynamic_index_in_dim(curves, low, keepdims=False)
    second = jax.lax.dynamic_index_in_dim(curves, low + 1, keepdims=False)
    if proportional:
        first, second = first / loads[low], second / loads[low + 1]
    at, slope = first + step * (second - first), (second - first) / gap
    return (at * force, at + slope) if proportional else (at, slope / force)


def _marginal(press: _Differences) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """z'z - z'V A^-1 V'z and log |A| of every patch, by a Cholesky factorisation written out over the few nuisances."""
    stops = range(len(press.contact))
    # Nuisances in order: slant along x and y, the force of each stop, first contact. The slant and first contact are
    # the same at all stops, and a force's error is that of its own stop.
    count = 3 + len(stops)
    gram: list[list[Array | float]] = [[0.0] * count for _ in range(count)]
    along: list[Array] = []
    for i in range(2):
        for j in range(i + 1):
            gram[i][j] = reduce(add, (_dot(press.sliding[s, i], press.sliding[s, j]) for s in stops))
        along.append(reduce(add, (_dot(press.sliding[s, i], press.reading[s]) for s in stops)))
    for s in stops:
        gram[2 + s][0], gram[2 + s][1] = (_dot(press.by_force[s], press.sliding[s, i]) for i in range(2))
        gram[2 + s][2 + s] = _dot(press.by_force[s], press.by_force[s]) + press.travel_by_force[s] ** 2
        gram[count - 1][2 + s] = press.contact[s] * press.travel_by_force[s]
        along.append(_dot(press.by_force[s], press.reading[s]) + press.travel_by_force[s] * press.travel[s])
    gram[-1][-1] = jnp.sum(press.contact**2)
    along.append(reduce(add, (press.contact[s] * press.travel[s] for s in stops)))
    distance = reduce(add, (_dot(press.reading[s], press.reading[s]) + press.travel[s] ** 2 for s in stops))
    explained, log_det = _eliminate(gram, along)
    return distance - explained, log_det


def _dot(a: Float[Array, "m n"], b: Float[Array, "m n"]) -> Float[Array, " n"]:
    """Sum of products over the first axis, written out: a CPU takes a chain of sums of long rows several times faster
    than a reduction across them.
    """
    return reduce(add, (a[k] * b[k] for k in range(len(a))))


def _eliminate(gram: list[list[Array | float]], along: list[Array]) -> tuple[Array, Array]:
    """b' (I + G)^-1 b and log |I + G| for a symmetric G whose lower triangle is given entry by entry."""
    factor: list[list[Array]] = []
    solved: list[Array] = []
    nothing = explained = log_det = jnp.zeros(())
    for i in range(len(along)):
        row: list[Array] = []
        for j in range(i):
            row.append((gram[i][j] - sum((row[k] * factor[j][k] for k in range(j)), nothing)) / factor[j][j])
        pivot = jnp.sqrt(1 + gram[i][i] - sum((each * each for each in row), nothing))
        solved.append((along[i] - sum((row[k] * solved[k] for k in range(i)), nothing)) / pivot)
        factor.append([*row, pivot])
        explained, log_det = explained + solved[-1] ** 2, log_det + 2 * jnp.log(pivot)
    return explained, log_det


def _blurred(image: Float[Array, "m m"], std: Float[Array, ""] | float) -> Float[Array, "m m"]:
    """Smooth by a Gaussian of a standard deviation in pixels, the outermost ones continued."""
    at = np.arange(image.shape[0])
    distance = (at[:, None] - at[None, :]) ** 2
    kernel = jnp.exp(-0.5 * distance / jnp.maximum(std, 1e-3) ** 2)
    kernel = kernel / jnp.sum(kernel, axis=1, keepdims=True)
    return kernel @ image @ kernel.T
