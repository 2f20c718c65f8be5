"""Evidence of one press on the surface: closed forms, dense linear algebra, small runs of the full physics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import i2t
from i2t.contact.press import PressLimits
from i2t.patches.dimensions import PAD_WINDOW, PATCH_WINDOW, REACH
from i2t.reconstruction import infer_patch
from i2t.reconstruction.library import library_from_contacts, sample_contacts
from i2t.reconstruction.local_shape import (
    _at_force,
    _blurred,
    log_likelihood,
    posterior_weights,
    summarize,
    systematic_samples,
)
from i2t.reconstruction.press_models import predict_presses
from i2t.rendering.render import render_heights
from i2t.simulation.press_curves import simulate_press_curve
from i2t.simulation.touches import SimulationErrors

TRUE = 7
INFER = jax.jit(infer_patch, static_argnames=("samples",))
JUDGE = jax.jit(log_likelihood)
FORCES = jnp.array([0.6, 2.0])


@pytest.fixture(scope="module")
def press(model):
    """What the pad reads at patch TRUE under two forces, both between the loads, without any error."""
    reading = FORCES[:, None] * model.reading[0, :, TRUE][None] / model.loads[0]
    knots = jnp.log(model.loads)
    travel = jnp.interp(jnp.log(FORCES), knots, model.travel[:, TRUE])
    return reading, FORCES, travel


@pytest.mark.full
def test_a_press_finds_the_true_patch_in_the_library(press, model, library):
    posterior = INFER(*press, model=model, library=library, samples=64)
    assert int(jnp.argmax(posterior.weight)) == TRUE
    assert float(posterior.weight[TRUE]) > 0.99
    np.testing.assert_allclose(posterior.mean, library.patch[TRUE], atol=1e-5)
    np.testing.assert_allclose(posterior.centre, library.centre[TRUE, 2], atol=1e-6)
    # The library is on the host, and may be closed over.
    closed_over = jax.jit(lambda weight: summarize(weight, FORCES[1], library=library, samples=64).mean)
    np.testing.assert_allclose(closed_over(posterior.weight), posterior.mean, atol=1e-6)


@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_a_stop_of_unknown_force_or_reading_is_ignored(press, model, library, lost):
    reading, force, travel = press
    alone = INFER(reading[0], force[0], travel[0], model=model, library=library)
    unread = INFER(reading.at[1, 2].set(lost), force, travel, model=model, library=library)
    unweighed = INFER(reading, force.at[1].set(lost), travel, model=model, library=library)
    nothing = INFER(reading, force * lost, travel, model=model, library=library)
    for posterior in (unread, unweighed):
        np.testing.assert_allclose(posterior.weight, alone.weight, atol=1e-6)
        np.testing.assert_allclose(posterior.centre, alone.centre, atol=1e-6)
    np.testing.assert_allclose(nothing.weight, 1 / 24, atol=1e-6)


def test_the_marginal_likelihood_equals_that_of_dense_matrices(press, model):
    """Nuisances are integrated out as a covariance that is written down whole and inverted."""
    reading, force, travel = press
    reading, travel = reading + 3.0, travel + 2e-5
    log_likelihood = JUDGE(reading, force, travel, model=model)
    what, loads = model.likelihood, np.asarray(model.loads)
    expected = []
    for i in range(model.reading.shape[-1]):
        residual, scale, columns = [], [], np.zeros((0, 5))
        for s, F in enumerate(np.asarray(force)):
            at = F * np.asarray(model.reading[0, :, i]) / loads[0]
            slope = at / F
            sliding = F * np.asarray(model.sliding[0, :, :, i]) / loads[0]
            error = what.relative_error**2 * np.mean(np.asarray(reading[s]) ** 2)
            knots = np.log(loads)
            low = np.searchsorted(knots, np.log(F)) - 1
            rate = (model.travel[low + 1, i] - model.travel[low, i]) / (knots[low + 1] - knots[low])
            travelled = model.travel[low, i] + rate * (np.log(F) - knots[low])
            residual += [*(np.asarray(reading[s]) - at), float(travel[s] - travelled)]
            scale += [*np.sqrt(np.asarray(model.noise) + error), what.travel_std]
            own = np.zeros((len(at) + 1, 5))
            own[:-1, :2] = what.slant_std * sliding.T
            own[:-1, 2 + s], own[-1, 2 + s] = what.force_std * slope, what.force_std * float(rate) / F
            own[-1, 4] = what.contact_std
            columns = np.concatenate([columns, own])
        residual, scale = np.array(residual), np.array(scale)
        covariance = np.diag(scale**2) + columns @ columns.T
        distance = residual @ np.linalg.solve(covariance, residual)
        log_det = np.linalg.slogdet(covariance)[1] - 2 * np.log(scale).sum()
        freedom = what.dof + len(residual)
        expected.append(-0.5 * log_det - 0.5 * freedom * np.log1p(distance / what.dof))
    np.testing.assert_allclose(log_likelihood, expected, rtol=2e-3, atol=2e-3)


@pytest.mark.full
def test_a_slant_does_not_count_against_a_patch(press, model):
    """The effect of friction on a slanted press costs far less as a nuisance than as an error."""
    reading, force, travel = press
    slanted = reading + 0.0175 * force[:, None] * model.sliding[0, 0, :, TRUE][None] / model.loads[0]
    blind, lost = model._replace(likelihood=model.likelihood._replace(slant_std=1e-6)), []
    for some in (model, blind):
        straight, slant = (JUDGE(felt, force, travel, model=some)[TRUE] for felt in (reading, slanted))
        lost.append(float(straight - slant))
    assert 0 < lost[0] < 0.5 * lost[1]


@pytest.mark.full
def test_missing_measurements_are_ignored(press, model, library):
    reading, force, travel = press
    once = INFER(reading[0], force[0], travel[0], model=model, library=library, samples=16)
    broken = (reading.at[1, 0].set(jnp.nan), force, travel)
    np.testing.assert_allclose(INFER(*broken, model=model, library=library, samples=16).weight, once.weight, atol=1e-5)
    blind = INFER(reading, force, model=model, library=library, samples=16)
    assert np.isfinite(blind.weight).all()
    assert float(blind.weight.sum()) == pytest.approx(1, abs=1e-5)


def test_no_touch_is_certain_while_the_prior_has_a_share_and_samples_come_in_proportion(model):
    weight = posterior_weights(jnp.array([0.0, -1e4, -1e4, -1e4]), model.likelihood._replace(prior_share=0.04))
    np.testing.assert_allclose(weight, [0.97, 0.01, 0.01, 0.01], atol=1e-6)
    drawn = np.asarray(systematic_samples(jnp.array([0.1, 0.6, 0.0, 0.3]), 100))
    np.testing.assert_allclose(np.bincount(drawn, minlength=4), [10, 60, 0, 30], atol=1)


def test_a_blurred_mask_has_the_variance_of_the_blur_and_keeps_constant_masks():
    mask = np.zeros((31, 31))
    mask[15, 15] = 1
    blurred, at = np.asarray(_blurred(jnp.float32(mask), 2.0)), np.arange(31) - 15
    np.testing.assert_allclose([blurred.sum(), blurred.sum(0) @ at**2, blurred.sum(1) @ at**2], [1, 4, 4], rtol=1e-4)
    np.testing.assert_allclose(_blurred(jnp.ones((9, 9)), 3.0), 1, rtol=1e-6)


@pytest.mark.full
def test_predicted_readings_equal_those_of_the_full_physics():
    """Presses on cells of 1 mm with loose tolerances are within a fifth of presses on cells of half a millimetre."""
    surface = i2t.prepare_surface(i2t.make_object("stamp-cross").mesh)
    contacts, objects = sample_contacts(jax.random.key(0), [surface], 3)
    pad = i2t.sample_pad(jax.random.key(1))
    model = predict_presses(pad, library_from_contacts(contacts, objects))

    def press(T):
        heights = render_heights(surface, jnp.linalg.inv(T), PAD_WINDOW, 40)
        errors, limits = SimulationErrors.error_free(), PressLimits()
        return simulate_press_curve(jax.random.key(2), pad, heights, errors=errors, limits=limits)

    presses = jax.jit(lambda T: jax.lax.map(press, T))(contacts.T_o_t)
    missed, read = np.zeros(2), np.zeros(2)
    for i, stop in np.ndindex(len(objects), 2):
        # Readings are nearly in proportion to the load between those of the library.
        imagined = _at_force(model.reading, model.loads, presses.force[i, stop])[0][:, i]
        reading = np.asarray(presses.reading[i, stop])
        missed[stop] += np.sum((model.axes.T @ imagined - reading) ** 2)
        read[stop] += np.sum(reading**2)
    assert (np.sqrt(missed / read) < 0.2).all(), np.sqrt(missed / read)


@pytest.mark.full
def test_one_renderer_draws_a_patch_and_both_grids_as_three_would():
    surface = i2t.prepare_surface(i2t.make_object("hammer").mesh)
    contacts, _ = sample_contacts(jax.random.key(0), [surface], 4)
    rendered = {"patch": (PATCH_WINDOW, 48), "height": (PAD_WINDOW, 40), "coarse": (PAD_WINDOW, 20)}
    for name, (window, pixels) in rendered.items():
        ours = np.asarray(getattr(contacts, name))
        for T, heights in zip(contacts.T_o_t, ours, strict=True):
            theirs = np.asarray(render_heights(surface, jnp.linalg.inv(T), window, pixels))
            theirs = np.clip(theirs, 0, REACH) if name == "patch" else theirs
            close = np.isclose(heights, theirs, atol=1e-6) | (np.isinf(heights) & np.isinf(theirs))
            assert close.mean() > 0.999, name  # a ray on an edge may meet the other face
