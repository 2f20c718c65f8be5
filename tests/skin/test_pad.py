"""Pads: as varied and as strong as real ones, and symmetric like the physics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t.patches.dimensions import PAD_WINDOW
from i2t.simulation.touches import SimulationErrors
from i2t.skin import faults
from i2t.skin import pad as pads
from i2t.skin.contact import GRID
from i2t.skin.dipoles import rest_field
from i2t.skin.noise import add_sensor_noise
from i2t.types import Pad
from tests.helpers.round_tips import round_tip

Y, X = np.meshgrid(GRID.centres, GRID.centres, indexing="ij")
press = jax.jit(pads.press)
press_force = jax.jit(pads.press_force)
PADS = 100
sample = jax.jit(jax.vmap(pads.sample_pad))


def _tip(x: float, y: float) -> np.ndarray:
    return round_tip(X, Y, (x, y)).astype(np.float32)


def _covers(values: np.ndarray, *real: float) -> bool:
    """Test whether the middle 80 % of simulated pads include the values of real boards."""
    low, high = np.quantile(values, [0.1, 0.9])
    return all(low < value < high for value in real)


@jax.jit
def press_pads(pads_: Pad, heights: jax.Array, forces: jax.Array) -> pads.Press:
    """Press each pad: results (pads, presses, n, n)."""
    press_all = jax.vmap(pads.press_force, (None, 0, 0))
    return jax.lax.map(lambda row: press_all(*row, forces), (pads_, heights))


@pytest.fixture(scope="module")
def samples() -> Pad:
    return sample(jax.random.split(jax.random.key(0), PADS))


@pytest.mark.full
def test_readings_agree_with_real_boards_and_pads_differ(samples):
    """Real boards: the norm of the 15 values has a median of 46-85 uT and a 95th percentile of 131-164 uT; 78-122 uT/N;
    the strongest chip's medians are 61, 22 and 36 uT (x, y, z); some chips are ten times stronger than others.
    """
    random = np.random.default_rng(0)
    heights = np.stack([_tip(*place) for place in random.uniform(-7e-3, 7e-3, (16, 2))])
    forces = random.uniform(0.6, 1.0, 16).astype(np.float32)
    pressed = jax.device_get(press_pads(samples, jnp.broadcast_to(heights, (PADS, *heights.shape)), forces))
    assert np.all(pressed.converged)
    np.testing.assert_allclose(pressed.force, np.broadcast_to(forces, (PADS, 16)), rtol=1e-5)
    norm = np.linalg.norm(pressed.reading, axis=-1)
    sensitivity = np.median(norm / forces, axis=1)
    assert 46 < np.median(norm) < 85
    assert 78 < np.median(sensitivity) < 122
    assert _covers(np.median(norm, axis=1), 46, 85)
    assert _covers(np.quantile(norm, 0.95, axis=1), 131, 164)
    assert _covers(sensitivity, 78, 122)
    chips = pressed.reading.reshape(PADS, 16, 5, 3)
    size = np.linalg.norm(chips, axis=-1)
    strongest = np.take_along_axis(np.abs(chips), size.argmax(axis=2)[..., None, None], axis=2)[:, :, 0]
    for axis, real in enumerate((61, 22, 36)):
        assert _covers(np.median(strongest[..., axis], axis=1), real), "xyz"[axis]
    assert _covers(np.median(size.max(axis=2) / size.min(axis=2), axis=1), 10)
    # Response maps of real boards are nearly uncorrelated. These are correlations of maps with a few independent
    # patches each, whose mean is zero within their spread.
    between = np.corrcoef(pressed.reading.reshape(PADS, -1))[np.triu_indices(PADS, 1)]
    assert abs(between.mean()) < 5 * between.std() / np.sqrt(PADS)
    assert np.mean(np.abs(between) > 0.6) < 0.05


@pytest.mark.full
def test_sessions_of_the_same_pad_are_similar(samples):
    """Response maps of a real board correlate 0.6-0.9 between sessions: remounted, used, warm, and with noise."""
    errors, random, some = SimulationErrors(), np.random.default_rng(1), jax.tree.map(lambda leaf: leaf[:30], samples)
    places = np.stack(np.meshgrid(*2 * [np.linspace(-7e-3, 7e-3, 4)], indexing="ij"), axis=-1).reshape(-1, 2)

    @jax.jit
    @jax.vmap
    def sensed(key: jax.Array, readings: jax.Array, pad: Pad) -> jax.Array:
        still = jnp.broadcast_to(jnp.eye(4), (len(readings), 4, 4))
        key_faults, key_noise = jax.random.split(key)
        own = {"key_board": faults.board_key(pad.gains), "rest": jnp.zeros(15)}
        felt = faults.apply(key_faults, readings, still, pad.board, errors.faults, **own)
        keys = jax.random.split(key_noise, len(readings))
        return jax.vmap(lambda key, reading: add_sensor_noise(key, reading, pad.board, errors.noise))(keys, felt)

    def session(seed: int) -> np.ndarray:
        """Record maps (pads, 16 x 15), with each pad remounted."""
        moved = places + errors.placement * random.normal(size=(30, 1, 2))
        heights = jnp.asarray(np.stack([[_tip(*place) for place in row] for row in moved]))
        pressed = press_pads(some, heights, jnp.full(len(places), 0.8))
        return np.asarray(sensed(jax.random.split(jax.random.key(seed), 30), pressed.reading, some)).reshape(30, -1)

    first, second = session(1), session(2)
    same, other = (
        np.array([np.corrcoef(a, b)[0, 1] for a, b in zip(first, maps, strict=True)])
        for maps in (second, np.roll(second, 1, axis=0))
    )
    assert 0.6 < np.median(same) < 0.9
    assert abs(np.mean(other)) < 5 * np.std(other) / np.sqrt(30)
    assert np.all(same > np.quantile(np.abs(other), 0.5))


@pytest.mark.full
def test_pads_stay_in_their_ranges_and_no_axis_rests_near_full_scale(samples):
    gap = -samples.board.chips[:, :, 2] - samples.thickness[:, None]
    for values, low, high in (
        (samples.thickness, 2e-3, 3e-3),
        (gap, 0.99e-3, 2.01e-3),
        (samples.poisson, *pads.NOMINAL_SKIN.poisson_range),
        (samples.gains, 0.85 - 1e-6, 1.15 + 1e-6),
        (samples.friction, 0.2, 1.5),
    ):
        assert np.all((values >= low) & (values <= high))
    assert np.std(samples.poisson) > 0.2 * np.ptp(pads.NOMINAL_SKIN.poisson_range)  # 0.29 of a uniform distribution
    assert np.std(samples.young) > 0
    assert np.all(samples.mount_compliance >= 0)
    assert 0.15 < np.mean(samples.mount_compliance > 0) < 0.52  # a third of 100, four standard deviations
    rest = jax.jit(jax.vmap(lambda pad: pad.board.to_board(rest_field(pad))))(samples)
    share = np.abs(rest) / np.tile([4915, 4915, 7930], 5)
    assert share.max() <= pads.NOMINAL_SKIN.max_range_share * (1 + 1e-4)
    assert share.max(axis=1).min() < 0.7 * pads.NOMINAL_SKIN.max_range_share  # which does not limit all pads


def test_smooth_maps_have_their_length_and_strength():
    length, cells = 4e-3, 20
    draw = jax.jit(jax.vmap(lambda key: pads.smooth_random(key, length, cells)))
    maps = np.asarray(draw(jax.random.split(jax.random.key(3), 500)))
    # 1500 independent values at each place: a mean square has an error of sqrt(2 / 1500) = 4 %; five such in all
    # places.
    np.testing.assert_allclose(np.mean(maps**2, axis=(0, 3)), 1, atol=5 * 0.04)
    for shift in (2, 5):
        product = np.mean(maps[:, :, shift:] * maps[:, :, :-shift], axis=(0, 1, 3))
        expected = 0.999 * np.exp(-0.5 * (shift * PAD_WINDOW / cells / length) ** 2)
        # Averaged over about 2.5 independent rows (20 mm / (sqrt(2 pi) 4 mm)) of 1500 values.
        np.testing.assert_allclose(product, expected, atol=5 * np.sqrt(2 / 3000))


def test_magnetisation_patterns():
    poles = np.asarray(pads.magnetization_pattern("poles"))
    assert not poles[..., :2].any()
    np.testing.assert_array_equal(poles[:5, :5, 2], 1)
    for axis in (0, 1):
        np.testing.assert_array_equal(poles, -np.roll(poles, 5, axis=axis))
    np.testing.assert_array_equal(pads.magnetization_pattern("uniform")[..., 2], np.ones((20, 20)))
    magnets = np.asarray(pads.magnetization_pattern("magnets"))[..., 2]
    assert np.abs(magnets).sum() == pytest.approx(4 * np.pi * 3**2, rel=0.15)  # discs in cells of 1 mm
    with pytest.raises(ValueError, match="'checkers' is not known; choose one of poles, uniform, magnets"):
        pads.magnetization_pattern("checkers")


@pytest.mark.full
def test_a_quarter_turn_turns_the_reading():
    """A uniform skin has the symmetry of the square: turning the object turns the field, including chips and axes."""
    pad = pads.nominal_pad("uniform")
    height = _tip(2.2e-3, 4.1e-3)
    turned = np.rot90(height, -1).copy()  # rows along y: the object turned a quarter from x to y
    np.testing.assert_allclose(turned, _tip(-4.1e-3, 2.2e-3), rtol=1e-6)
    plain = np.asarray(pad.board.to_tool(press(pad, jnp.asarray(height), 0.5e-3).reading))
    rotated = np.asarray(pad.board.to_tool(press(pad, jnp.asarray(turned), 0.5e-3).reading))
    centre, plus_x, plus_y, minus_y, minus_x = range(5)
    moved = plain[[centre, minus_y, plus_x, minus_x, plus_y]]  # the chip that lies a quarter turn behind
    expected = np.stack([-moved[:, 1], moved[:, 0], moved[:, 2]], axis=-1)
    np.testing.assert_allclose(rotated, expected, atol=1e-4 * np.abs(plain).max())  # ten times the contact's tolerance

    # Pressing above a chip changes that chip most.
    for i, (x, y, _) in enumerate(np.asarray(pad.board.chips)):
        field = pad.board.to_tool(press(pad, jnp.asarray(_tip(x, y)), 0.5e-3).reading)
        assert np.argmax(np.linalg.norm(field, axis=1)) == i


@pytest.mark.full
def test_friction_changes_the_reading():
    """With friction a slide changes the reading more and more until all of the skin slips; without, nothing changes."""
    pad, height = pads.sample_pad(jax.random.key(2)), jnp.asarray(_tip(1e-3, 2e-3))
    mark = jax.jit(lambda pad, slide: pads.friction_response(pad, height, 0.4e-3, jnp.stack([slide, 0.0])))
    np.testing.assert_allclose(mark(pad._replace(friction=jnp.asarray(0.0)), 1e-4), np.zeros(15), atol=1e-3)
    slides = np.array([0, 1e-5, 1e-4, 1e-3, 2e-3, -1e-4])
    marks = np.stack([mark(pad, jnp.asarray(slide)) for slide in slides])
    size = np.linalg.norm(marks - marks[0], axis=1)
    assert np.all(np.diff(size[:5]) > -1e-3 * size[4])
    assert size[4] == pytest.approx(size[3], rel=0.05)  # full slip, where friction has its largest force
    assert np.dot(marks[5] - marks[0], marks[2] - marks[0]) < 0


def test_the_gains_that_identify_a_board_are_computed_one_operation_at_a_time():
    """Another fusion would give other last bits, and so other faults of the board."""
    key = jax.random.key(3)
    drawn = jax.random.truncated_normal(jax.random.split(key, len(pads.DRAWN))[5], -3.0, 3.0, (15,))
    np.testing.assert_array_equal(pads.sample_pad(jax.random.clone(key)).gains, 1 + 0.05 * drawn)
