"""Local shape from one press: a posterior over the patches of a library.

A library holds patches of many shapes (`i2t.reconstruction.library`), and a `PressModel` the readings of one pad at
each of them under a few loads. A press is one or more stops, each with a reading (uT), a force (N) and a travel past
first contact (m). Two stops of one press, for example at 25 and at 100 uT, are a press curve. Each patch i of the
library is weighted by how well it explains the whole press,

    y = r_i(F) + (U_i a + e) / sqrt(g),    a ~ N(0, I),    e ~ N(0, D),    g ~ Gamma(k/2, k/2),

where r_i is interpolated at the measured force and the columns of U_i are nuisances that are integrated out: the slant
of the press along two axes (friction, the same at all its stops), the error of each force, and that of first contact.
Thus y has a multivariate Student's t distribution with k degrees of freedom. With z = D^-1/2 (y - r_i),
V = D^-1/2 U_i and A = I + V'V,

    log w_i = 1 / (T S) [ -1/2 log |A| - (k + m)/2 log(1 + (z'z - z'V A^-1 V'z) / k) ]

with m measured values at S stops, and a temperature T, because no patch is exact and the errors of a model are alike in
all channels. A fraction of the prior stays mixed in, so that no touch gives certainty. Posterior samples are drawn from
the weights systematically and have equal weights.

Frames and units as in `i2t.types`. A patch is the surface in front of the skin at first contact: metres along tool z
beyond the plane of first contact, clipped to the reach. All functions are pure and work on one press; compile them at
the edge:

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


class PatchLibrary(NamedTuple):
    """n patches of many shapes, as depths (m) beyond the plane of first contact, and presses of a nominal layer onto
    each at l loads (N): force on each cell (N), indentation (m) and centre of pressure (m). The same for every pad.
    """

    patch: Float[Any, "n p p"]  # m, depth beyond the plane of first contact, clipped to the reach
    # m, depth beyond the plane of first contact over the cells of the pad, not clipped (+inf where there is no surface)
    height: Float[Any, "n g g"]
    object: Int[Any, " n"]  # index of the shape of each patch
    loads: Float[Any, " l"]  # N, loads of the presses, ascending
    newtons: Float[Any, "n l cells"]  # N, force on each cell of 1 mm, row along tool y
    indentation: Float[Any, "n l"]  # m, indentation of the nominal layer past first contact
    centre: Float[Any, "n l 2"]  # m, centre of pressure (x, y)


class PatchLikelihood(NamedTuple):
    """Sizes of the errors of a measured press about the predicted one, and options of the weights, for inference of the
    patch: standard deviations of slant (m/m), force (N), travel and first contact (m), relative error of readings,
    degrees of freedom, temperature, fraction of the prior, and blur of masks (pixels).

    The values are close to those that `experiments.reconstruct patch` chooses on validation objects.
    """

    # m/m, standard deviation of the slant of the press's motion along x and y (1 degree)
    slant_std: Float[Array, ""] | float = 0.01745
    force_std: Float[Array, ""] | float = 0.1  # N, standard deviation of the force at each stop
    travel_std: Float[Array, ""] | float = 0.07e-3  # m, standard deviation of the travel at each stop
    # m, standard deviation of first contact, the same at all stops of a press
    contact_std: Float[Array, ""] | float = 0.1e-3
    relative_error: Float[Array, ""] | float = 0.1  # error of predicted readings, relative to the reading's norm
    dof: Float[Array, ""] | float = 6.0  # degrees of freedom of Student's t
    # divisor T of the log likelihood, multiplied by the number of stops, whose errors are alike
    temperature: Float[Array, ""] | float = 2.0
    prior_share: Float[Array, ""] | float = 0.02  # fraction of the prior in the weights
    blur: Float[Array, ""] | float = 1.0  # pixels, smoothing of the probabilities of masks


class PressModel(NamedTuple):
    """Predicted readings (uT), their change by a slanted press, and travels (m) of one pad at each of a library's n
    patches under each of its l loads (N), with the sensor's noise and the likelihood of measurements.

    Readings are turned to the axes in which the sensor's noise is independent. Their axis comes first in memory, and
    that of the patches last, because every touch needs all patches.
    """

    loads: Float[Array, " l"]  # N, loads of the presses
    reading: Float[Array, "l c n"]  # uT, predicted readings at each load
    sliding: Float[Array, "l 2 c n"]  # uT, change of the reading by a slant of 1 m/m along x and y
    travel: Float[Array, "l n"]  # m, travel past first contact, including the deflection of arm and mount
    axes: Float[Array, "c c"]  # matrix that turns a reading to independent axes: axes @ reading
    noise: Float[Array, " c"]  # uT^2, noise variance along each of those independent axes
    likelihood: PatchLikelihood


class PatchPosterior(NamedTuple):
    """Posterior over the n patches of a library, given a press: weights, k equally weighted samples and their mean (m),
    probabilities of contact, and mean (m) and covariance (m^2) of the centre of pressure.
    """

    weight: Float[Array, " n"]  # weights of the library's patches; they sum to 1
    rows: Int[Array, " k"]  # rows of the samples in the library
    patch: Float[Array, "k p p"]  # m, sampled patches: depth beyond the plane of first contact
    mean: Float[Array, "p p"]  # m, mean patch
    # probability that the surface is within 1.5 mm of the plane of first contact (the paper's mask)
    mask_probability: Float[Array, "p p"]
    # probability that a cell of 1 mm bears pressure, at the load nearest the last stop's
    contact_probability: Float[Array, "g g"]
    centre: Float[Array, "2"]  # m, centre of pressure (x, y) at the load nearest the last stop's
    centre_covariance: Float[Array, "2 2"]  # m^2, covariance of the centre of pressure


def infer_patch(
    reading: Float[Array | np.ndarray, "*s c"],
    force: Float[Array | np.ndarray, "*s"] | float,
    travel: Float[Array | np.ndarray, "*s"] | float = jnp.nan,
    *,
    model: PressModel,
    library: PatchLibrary,
    samples: int = 256,
) -> PatchPosterior:
    """Infer the local surface that one press met, as a posterior over the patches of a library.

    Args:
        reading: Readings (uT) at the one stop of a press, (c,), or at several, (s, c), in the board's order and axes.
            A stop with a non-finite reading or force is ignored.
        force: Force (N) at each stop; a force below 0.02 N is raised to it.
        travel: Travel (m) past first contact at each stop; NaN if it was not measured.
        model: Readings of the pad at the library's patches.
        library: The patches.
        samples: Number of posterior samples; static.

    Returns:
        Posterior over the library's patches, with its samples, means and probabilities.

    Raises:
        ValueError: A force is larger than a skin withstands.

    Example:
        infer = jax.jit(infer_patch, static_argnames=("samples",))
        posterior = infer(touch.reading, touch.force, touch.travel, model=model, library=library)
        posterior.mean, posterior.mask_probability, jnp.quantile(posterior.patch, 0.9, axis=0)
    """
    if not validation.is_traced(force):
        forces = np.asarray(force, float)
        validation.forces("force", forces[np.isfinite(forces)], measured=True)
    reading = jnp.atleast_2d(jnp.asarray(reading))
    force = jnp.atleast_1d(jnp.asarray(force, reading.dtype))
    valid = jnp.all(jnp.isfinite(reading), axis=1) & jnp.isfinite(force)
    reading = jnp.where(valid[:, None], reading, jnp.nan)
    force = jnp.maximum(jnp.where(valid, force, 0.0), 0.02)  # N, about the noise of a wrench sensor
    travel = jnp.broadcast_to(jnp.asarray(travel, reading.dtype), force.shape)
    last = force[jnp.max(jnp.where(valid, jnp.arange(len(force)), 0))]
    if len(reading) == 1:  # the compiler removes a loop of one step, see `log_likelihood`
        reading = jnp.concatenate([reading, jnp.full_like(reading, jnp.nan)])
        force, travel = jnp.tile(force, 2), jnp.tile(travel, 2)
    log_weight = log_likelihood(reading, force, travel, model=model)
    weight = posterior_weights(log_weight, model.likelihood, jnp.sum(valid))
    return summarize(weight, last, library=library, blur=model.likelihood.blur, samples=samples)


def log_likelihood(
    reading: Float[Array, "s c"], force: Float[Array, " s"], travel: Float[Array, " s"], *, model: PressModel
) -> Float[Array, " n"]:
    """Compute the log likelihood of a press under each patch of the library, up to a constant.

    Args:
        reading: Reading (uT) at each stop; a stop with a NaN is ignored.
        force: Force (N) at each stop, above 0.
        travel: Travel (m) past first contact at each stop; NaN if it was not measured.
        model: Readings of the pad at the library's patches.

    Returns:
        `(n,)` logarithms of the likelihood, neither tempered nor normalised.
    """
    errors = model.likelihood
    valid = jnp.all(jnp.isfinite(reading), axis=1)
    turned = jnp.where(valid[:, None], reading, 0) @ model.axes.T

    def compare(stop: tuple[Array, Array, Array, Array]) -> _Differences:
        reading, force, travel, valid = stop
        error = errors.relative_error**2 * jnp.mean(reading**2)
        scale = valid / jnp.sqrt(model.noise + error)[:, None]
        at, slope = _at_force(model.reading, model.loads, force)
        travel_scale = (valid & jnp.isfinite(travel)) / errors.travel_std
        travelled, travel_slope = _at_force(model.travel, model.loads, force, proportional=False)
        return _Differences(
            reading=scale * (reading[:, None] - at),
            travel=travel_scale * (jnp.where(travel_scale > 0, travel, 0) - travelled),
            sliding=errors.slant_std * scale[None] * _at_force(model.sliding, model.loads, force)[0],
            by_force=errors.force_std * scale * slope,
            travel_by_force=travel_scale * errors.force_std * travel_slope,
            contact=travel_scale * errors.contact_std,
        )

    # One stop after the other: fused with the code below, each sum there would interpolate again.
    distance, log_det = _marginal(jax.lax.map(compare, (turned, force, travel, valid)))
    measured = jnp.sum(valid * (reading.shape[1] + jnp.isfinite(travel)))
    return -0.5 * log_det - 0.5 * (errors.dof + measured) * jnp.log1p(distance / errors.dof)


def posterior_weights(
    log_likelihood: Float[Array, " n"], likelihood: PatchLikelihood, stops: Int[Array, ""] | int = 1
) -> Float[Array, " n"]:
    """Convert log likelihoods to posterior weights of the library's patches, tempered and mixed with the prior.

    Args:
        log_likelihood: `(n,)` log likelihood of the press under each patch.
        likelihood: The temperature and the fraction of the prior.
        stops: Number of stops of the press.

    Returns:
        `(n,)` weights that sum to 1.
    """
    weight = jax.nn.softmax(log_likelihood / (likelihood.temperature * jnp.maximum(stops, 1)))
    return (1 - likelihood.prior_share) * weight + likelihood.prior_share / len(weight)


def summarize(
    weight: Float[Array, " n"],
    force: Float[Array, ""],
    *,
    library: PatchLibrary,
    blur: Float[Array, ""] | float = 0.0,
    samples: int = 256,
) -> PatchPosterior:
    """Summarise a posterior over patches: mean patch, samples, contact probabilities and centre of pressure.

    Args:
        weight: `(n,)` weights of the patches, which sum to 1.
        force: Force (N) of the last stop, which selects the load of the contacts.
        library: The patches.
        blur: Smoothing (pixels) of the probabilities of masks.
        samples: Number of posterior samples; static.

    Returns:
        Posterior over the library's patches, with its samples, means and probabilities.
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
    """Draw indices in proportion to weights, as evenly as possible and without random numbers (Kitagawa, J. Comput.
    Graph. Stat. 5, 1996).

    Args:
        weight: `(n,)` weights that sum to 1.
        samples: Number k of indices; static.

    Returns:
        `(k,)` ascending indices, with repetitions where a weight is large.
    """
    total = jnp.cumsum(weight)
    wanted = (jnp.arange(samples) + 0.5) / samples * total[-1]
    return jnp.minimum(jnp.searchsorted(total, wanted), len(weight) - 1)


class _Differences(NamedTuple):
    """Differences of a press from each predicted one, and effects of nuisances, all in standard deviations."""

    reading: Float[Array, "s c n"]
    travel: Float[Array, "s n"]
    sliding: Float[Array, "s 2 c n"]  # change of the readings for a slant of one standard deviation
    by_force: Float[Array, "s c n"]  # change of the readings for an error of the force
    travel_by_force: Float[Array, "s n"]
    contact: Float[Array, " s"]  # change of the travel for an error of first contact


def _at_force(
    curves: Array, loads: Array, force: Array, *, proportional: bool = True
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Interpolate curves over loads (l, ...) at a force, with their derivative by the force.

    The interpolation is linear in the logarithm of the load, for proportional curves of their values per newton, and
    extrapolates by at most one step beyond the outer loads.
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
    """Compute z'z - z'V A^-1 V'z and log |A| of every patch, by a Cholesky factorisation that is written out over the
    few nuisances.
    """
    stops = range(len(press.contact))
    # Nuisances in order: slant along x and y, the force of each stop, first contact. The slant and first contact are
    # shared by all stops, and the error of a force belongs to its own stop.
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
    """Sum products over the first axis, written out: a CPU adds a chain of long rows several times faster than it
    reduces across them.
    """
    return reduce(add, (a[k] * b[k] for k in range(len(a))))


def _eliminate(gram: list[list[Array | float]], along: list[Array]) -> tuple[Array, Array]:
    """Compute b' (I + G)^-1 b and log |I + G| for a symmetric G, given by the entries of its lower triangle."""
    factor: list[list[Array]] = []
    solved: list[Array] = []
    nothing = explained = log_det = jnp.zeros(())
    for i in range(len(along)):
        row: list[Array] = []
        for j in range(i):
            row.append((gram[i][j] - sum((row[k] * factor[j][k] for k in range(j)), nothing)) / factor[j][j])
        pivot = jnp.sqrt(1 + gram[i][i] - sum((entry * entry for entry in row), nothing))
        solved.append((along[i] - sum((row[k] * solved[k] for k in range(i)), nothing)) / pivot)
        factor.append([*row, pivot])
        explained, log_det = explained + solved[-1] ** 2, log_det + 2 * jnp.log(pivot)
    return explained, log_det


def _blurred(image: Float[Array, "m m"], std: Float[Array, ""] | float) -> Float[Array, "m m"]:
    """Smooth an image by a Gaussian with a standard deviation in pixels, continuing the outermost pixels."""
    at = np.arange(image.shape[0])
    distance = (at[:, None] - at[None, :]) ** 2
    kernel = jnp.exp(-0.5 * distance / jnp.maximum(std, 1e-3) ** 2)
    kernel = kernel / jnp.sum(kernel, axis=1, keepdims=True)
    return kernel @ image @ kernel.T
