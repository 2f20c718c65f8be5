"""A stack of elastic layers against a single layer in the limits, and against the half-space of its top."""

import jax
import numpy as np
import pytest

from i2t.skin import elasticity
from i2t.skin.elasticity import GRID
from i2t.skin.layered import Sheet, stack_motion
from i2t.skin.pad import nominal_pad

H, E, NU = 2e-3, 150e3, 0.48
K = np.hypot(GRID.wavenumbers[:, None], GRID.wavenumbers[None, :])
DEPTHS = np.array([0, 0.3e-3, 1e-3, 1.6e-3])
SPLITS = {
    "one layer": [Sheet(H, E, NU)],
    "two equal layers": [Sheet(0.7e-3, E, NU), Sheet(H - 0.7e-3, E, NU)],
    "three equal layers": [Sheet(H / 3, E, NU)] * 3,
    "on a layer that is nearly rigid": [Sheet(H, E, NU), Sheet(1e-3, 1e9 * E, 0.3)],
}


@pytest.mark.parametrize("sheets", SPLITS.values(), ids=SPLITS)
def test_a_stack_that_is_equivalent_to_one_layer_moves_like_it(sheets):
    with jax.enable_x64(True):
        pad = nominal_pad()._replace(thickness=H, young=E, poisson=NU)
        surface = np.asarray(elasticity.compliance(pad, GRID))
        layer = [elasticity._under_pressure(pad, GRID, depth) for depth in DEPTHS]
    stack = stack_motion(sheets, K, DEPTHS)
    np.testing.assert_allclose(-stack.down[0], surface, rtol=1e-7)
    for ours, theirs in zip(stack, zip(*layer, strict=True), strict=True):
        expected = np.stack(theirs)
        sloped = np.where(ours is stack.down, K >= 0, K > 0)  # a uniform pressure has no slope
        np.testing.assert_allclose(ours * sloped, expected * sloped, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


def test_short_waves_depend_on_the_top_and_long_ones_on_all_layers():
    top, under = Sheet(1e-3, E, NU), Sheet(1e-3, 4 * E, 0.3)
    k = np.array([0.0, 20e3])
    flat, short = -stack_motion([top, under], k, np.zeros(1)).down[0]
    alone = [-stack_motion([sheet], k, np.zeros(1)).down[0, 0] for sheet in (top, under)]
    assert flat == pytest.approx(sum(alone), rel=1e-12)
    assert short == pytest.approx((1 - NU) / (top.shear * k[1]), rel=1e-6)


def test_the_motion_is_continuous_between_layers_and_zero_at_the_base():
    sheets = [Sheet(0.8e-3, 0.5 * E, NU), Sheet(1.2e-3, 2 * E, 0.4)]
    above, below, base = (
        np.stack(stack_motion(sheets, K, np.array([depth]))[:2]) for depth in (0.8e-3, 0.8e-3 + 1e-12, H)
    )
    np.testing.assert_allclose(above, below, atol=1e-8 * np.abs(above).max())
    assert np.abs(base).max() < 1e-12 * np.abs(above).max()
