"""Pads: as different and as strong as real ones, and symmetric where physics is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.skin import pad as pads
from i2t.skin.contact import GRID
from i2t.types import PAD_WINDOW

Y, X = np.meshgrid(GRID.centres, GRID.centres, indexing="ij")
press = jax.jit(pads.press)
press_force = jax.jit(pads.press_force)
sample = jax.jit(jax.vmap(pads.sample_pad))


def _tip(x: float, y: float, radius: float = 2.3e-3) -> np.ndarray:
    square = radius**2 - (X - x) ** 2 - (Y - y) ** 2
    return np.where(square > 0, radius - np.sqrt(np.maximum(square, 0)), np.inf).astype(np.float32)


@pytest.fixture(scope="module")
def presses():
    """48 random pads, each pressed by a tip of 4.6 mm to 0.6-1.0 N at the same 16 places."""
    random = np.random.default_rng(0)
    heights = jnp.asarray(np.stack([_tip(*place) for place in random.uniform(-7e-3, 7e-3, (16, 2))]))
    forces = jnp.asarray(random.uniform(0.6, 1.0, 16), jnp.float32)
    samples = sample(jax.random.split(jax.random.key(0), 48))
    each = jax.vmap(pads.press_force, (None, 0, 0))
    found = jax.jit(lambda pads: jax.lax.map(lambda pad: each(pad, heights, forces), pads))(samples)
    return samples, np.asarray(forces), jax.tree.map(np.asarray, found)


def test_readings_are_as_large_as_real_ones(presses):
    """Real boards: median norm of the 15 values 46-85 uT, 78-122 uT/N, some chips ten times stronger than others."""
    _, forces, found = presses
    assert np.all(found.converged)
    norm = np.linalg.norm(found.reading, axis=-1)
    assert 46 < np.median(norm) < 85
    assert 78 < np.median(norm / forces) < 122
    per_pad = np.median(norm, axis=1)
    assert np.quantile(per_pad, 0.1) < 46 < 85 < np.quantile(per_pad, 0.9)  # the range of real boards is covered
    chips = np.linalg.norm(found.reading.reshape(48, 16, 5, 3), axis=-1)
    assert np.median(chips.max(axis=2) / chips.min(axis=2)) > 5
    np.testing.assert_allclose(found.force, np.broadcast_to(forces, (48, 16)), rtol=1e-5)


def test_maps_of_different_pads_are_unrelated(presses):
    _, _, found = presses
    maps = found.reading.reshape(48, -1)
    between = np.corrcoef(maps)[np.triu_indices(48, 1)]
    # 1128 correlations of maps with a few independent patches each: their mean is zero within their own spread.
    assert abs(between.mean()) < 5 * between.std() / np.sqrt(48)
    assert np.abs(between).max() < 0.9


def test_pads_stay_in_their_ranges(presses):
    samples, _, _ = presses
    assert np.all((samples.thickness >= 2e-3) & (samples.thickness <= 3e-3))
    gap = -samples.board.chips[:, :, 2] - samples.thickness[:, None]
    assert np.all((gap >= 0.99e-3) & (gap <= 2.01e-3))
    assert np.std(samples.young) > 0
    assert np.all(np.abs(samples.gains - 1) <= 0.15 + 1e-6)


def test_without_spread_only_the_magnetisation_differs():
    one, two = (pads.sample_pad(jax.random.key(seed), 0.0) for seed in (1, 2))
    assert np.abs(one.magnetisation - two.magnetisation).max() > pads.STRENGTH / 10
    same = [pad._replace(magnetisation=None) for pad in (one, two)]
    jax.tree.map(np.testing.assert_array_equal, *same)
    np.testing.assert_allclose(one.thickness, pads.THICKNESS)
    np.testing.assert_array_equal(one.gains, np.ones(15))


def test_keys_of_a_batch_are_independent():
    keys = jax.random.split(jax.random.key(4), 3)
    together = sample(keys)
    for i, key in enumerate(keys):
        alone = pads.sample_pad(key)
        np.testing.assert_allclose(alone.magnetisation, together.magnetisation[i], atol=1e-3 * pads.STRENGTH)
        np.testing.assert_allclose(alone.gains, together.gains[i], rtol=1e-6)


def test_smooth_maps_have_their_length_and_strength():
    length, cells = 4e-3, 20
    draw = jax.jit(jax.vmap(lambda key: pads.smooth_random(key, length, cells)))
    maps = np.asarray(draw(jax.random.split(jax.random.key(3), 500)))
    # 1500 independent values at each place: a mean square errs by sqrt(2 / 1500) = 4 %, five such over all places.
    np.testing.assert_allclose(np.mean(maps**2, axis=(0, 3)), 1, atol=5 * 0.04)
    for shift in (2, 5):
        product = np.mean(maps[:, :, shift:] * maps[:, :, :-shift], axis=(0, 1, 3))
        expected = 0.999 * np.exp(-0.5 * (shift * PAD_WINDOW / cells / length) ** 2)
        # Averaged over about 2.5 independent rows (20 mm / (sqrt(2 pi) 4 mm)) of 1500 values.
        np.testing.assert_allclose(product, expected, atol=5 * np.sqrt(2 / 3000))


def test_magnetisation_patterns():
    poles = np.asarray(pads.magnetise("poles"))
    assert poles.shape == (20, 20, 3)
    assert np.all(poles[..., :2] == 0)
    assert np.all(np.abs(poles[..., 2]) == 1)
    assert poles.sum() == 0
    np.testing.assert_array_equal(poles[:5, :5, 2], 1)
    np.testing.assert_array_equal(poles, -np.roll(poles, 5, axis=0))
    np.testing.assert_array_equal(pads.magnetise("uniform")[..., 2], np.ones((20, 20)))
    with pytest.raises(ValueError, match="'checkers' is not known; choose one of poles, uniform"):
        pads.magnetise("checkers")


def test_a_quarter_turn_turns_the_reading():
    """A uniform skin has the symmetry of the square: turning the object turns the field, and with it chips and axes."""
    pad = pads.nominal_pad("uniform")
    height = _tip(2.2e-3, 4.1e-3)
    turned = np.rot90(height, -1).copy()  # rows along y: the object turned a quarter from x to y
    np.testing.assert_allclose(turned, _tip(-4.1e-3, 2.2e-3), rtol=1e-6)
    plain = np.asarray(pad.board.to_tool(press(pad, jnp.asarray(height), 0.5e-3).reading))
    rotated = np.asarray(pad.board.to_tool(press(pad, jnp.asarray(turned), 0.5e-3).reading))
    centre, plus_x, plus_y, minus_y, minus_x = range(5)
    moved = plain[[centre, minus_y, plus_x, minus_x, plus_y]]  # the chip a quarter turn behind
    expected = np.stack([-moved[:, 1], moved[:, 0], moved[:, 2]], axis=-1)
    np.testing.assert_allclose(rotated, expected, atol=1e-4 * np.abs(plain).max())  # the contact's tolerance, tenfold


def test_chips_feel_what_is_above_them():
    """Pressing above a chip of a uniformly magnetised skin changes that chip most."""
    pad = pads.nominal_pad("uniform")
    for i, (x, y, _) in enumerate(np.asarray(pad.board.chips)):
        field = pad.board.to_tool(press_force(pad, jnp.asarray(_tip(x, y)), 0.8).reading)
        assert np.argmax(np.linalg.norm(field, axis=1)) == i


def test_press_and_press_force_are_inverse():
    pad, height = pads.nominal_pad(), jnp.asarray(_tip(1e-3, -3e-3))
    there = press(pad, height, 0.4e-3)
    back = press_force(pad, height, there.force)
    np.testing.assert_allclose(back.indentation, there.indentation, rtol=1e-4)  # ten times the solver's tolerance
    np.testing.assert_allclose(back.reading, there.reading, atol=1e-3 * np.abs(there.reading).max())
    assert there.converged
    assert back.converged


def test_air_gives_nothing():
    found = press(pads.nominal_pad(), jnp.full((40, 40), jnp.inf), 0.5e-3)
    assert found.force == 0
    assert found.converged
    np.testing.assert_allclose(found.reading, np.zeros(15), atol=1e-3)  # rounding of fields of some mT
