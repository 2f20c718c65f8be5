"""What the experiment on simulated pads presses."""

import jax
import numpy as np

from experiments import calibrate_pads


def test_pads_are_pressed_as_stated():
    pads, presses, readings = calibrate_pads.pressed(jax.random.key(0), 2, 6)
    assert readings.shape == (2, 6, 15)
    assert pads.magnetisation.shape[0] == 2
    assert np.isfinite(readings).all()
    assert np.abs(presses.place).max() < calibrate_pads.HALF
    assert (presses.load > 0.2).all()
    assert (presses.load < 1).all()
