"""Sensor errors added to the field: white noise, a slow ambient field, and the steps of the converter.

A chip's sample is `quantise(field + ambient + white)`; a reading is the mean of the samples in contact minus the mean
of the samples before contact. Sizes come from recordings of real ReSkin boards at rest with the paper's settings
(MLX90393, gain 7, resolution 0, oversampling 0, filter 2): 3.1 uT (x, y) and 4.6 uT (z) in one sample; 20-33 % of that
variance is one slow field that all chips share in common axes; steps of 0.150 and 0.242 uT; drifts of 1-15 uT over a
session of thousands of presses.

Readings are microtesla in the board's order and the chips' own axes. Each function takes one reading and is lifted by
`vmap`.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from i2t.runtime.compiling import traced_floats
from i2t.types import Board


@traced_floats
@dataclass(frozen=True)
class Noise:
    """Sizes of the magnetometers' noise and converter steps (uT; 0 turns one off), and numbers of averaged samples.

    Example:
        errors = i2t.SimulationErrors(noise=i2t.Noise(contact_samples=1))  # readings without averaging
    """

    xy: float = 3.1  # uT, standard deviation of one sample at rest, for each of x and y
    z: float = 4.6  # uT, standard deviation of one sample at rest, for z
    common: float = 0.26  # share of the noise variance that is the slow ambient field
    step_xy: float = 0.150  # uT, step of the converter along x and y
    step_z: float = 0.242
    ambient_samples: int = 10  # number of samples averaged before contact, as in the paper
    contact_samples: int = 10  # number of samples averaged in contact

    @classmethod
    def none(cls) -> "Noise":
        """Return an ideal sensor, without noise and steps."""
        return cls(xy=0.0, z=0.0, common=0.0, step_xy=0.0, step_z=0.0)

    def scaled(self, factor: float) -> "Noise":
        """Scale the noise by a factor; the steps of the converter stay.

        Args:
            factor: Factor on the standard deviations.

        Returns:
            The sensor with the scaled noise.
        """
        return replace(self, xy=factor * self.xy, z=factor * self.z)

    def sigma(self, chips: int) -> Float[Any, " c"]:
        """Compute the standard deviation of one sample at rest, for each channel of a board.

        Args:
            chips: Number of chips of the board.

        Returns:
            `(3 chips,)` standard deviations (uT).
        """
        return _of_axes(self.xy, self.z, chips)

    def steps(self, chips: int) -> Float[Any, " c"]:
        """List the converter's steps for each channel of a board.

        Args:
            chips: Number of chips of the board.

        Returns:
            `(3 chips,)` steps (uT).
        """
        return _of_axes(self.step_xy, self.step_z, chips)


def _of_axes(xy: Any, z: Any, chips: int) -> Float[Any, " c"]:
    """Repeat values of x, y and z for each chip, in JAX if one of them is traced and otherwise in NumPy."""
    xp = jnp if isinstance(xy, jax.Array) or isinstance(z, jax.Array) else np
    return xp.tile(xp.array([xy, xy, z]), chips)


def add_sensor_noise(
    key: Key[Array, ""], reading: Float[Array, " c"], board: Board, noise: Noise | None = None
) -> Float[Array, " c"]:
    """Simulate a recorded touch: the mean of the samples in contact minus the mean of the samples before contact.

    The slow field is assumed constant within a burst of samples (25 ms for 10 at 400 Hz) and drawn anew for the next
    one (a press later), so averaging more samples does not remove it. Drift within one touch is far smaller and is
    neglected.

    Args:
        key: Random key.
        reading: `(c,)` reading (uT) of an ideal sensor.
        board: The board that measures it.
        noise: Sizes of the errors, by default those of real boards.

    Returns:
        `(c,)` reading (uT) with errors.
    """
    noise = Noise() if noise is None else noise
    key_contact, key_ambient = jax.random.split(key)
    contact = sample_burst(key_contact, reading, board, noise, noise.contact_samples)
    rest = sample_burst(key_ambient, jnp.zeros_like(reading), board, noise, noise.ambient_samples)
    return jnp.mean(contact, axis=0) - jnp.mean(rest, axis=0)


def sample_burst(
    key: Key[Array, ""], reading: Float[Array, " c"], board: Board, noise: Noise, samples: int
) -> Float[Array, "s c"]:
    """Simulate a burst of raw samples of one reading, so quick that they differ only in the white noise.

    Args:
        key: Random key.
        reading: `(c,)` reading (uT) of an ideal sensor.
        board: The board that measures it.
        noise: Sizes of the errors.
        samples: Number of samples.

    Returns:
        `(samples, c)` samples (uT).
    """
    key_ambient, key_white = jax.random.split(key)
    field = reading + ambient(key_ambient, board, noise)
    sigma = noise.sigma(board.num_chips)[None]
    own = sigma * jnp.sqrt(1 - noise.common) * jax.random.normal(key_white, (samples, board.num_readings))
    return quantise(field[None] + own, noise)


def ambient(key: Key[Array, ""], board: Board, noise: Noise) -> Float[Array, " c"]:
    """Draw the slow ambient field at one moment: one vector in tool axes, measured by every chip in its own axes.

    Args:
        key: Random key.
        board: The board that measures it.
        noise: Sizes of the errors.

    Returns:
        `(c,)` reading of the field (uT).
    """
    field = jnp.sqrt(noise.common) * noise.sigma(1) * jax.random.normal(key, (3,))
    return board.to_board(jnp.broadcast_to(field, (board.num_chips, 3)))


def quantise(readings: Float[Array, "*n c"], noise: Noise) -> Float[Array, "*n c"]:
    """Round readings to the converter's steps.

    Args:
        readings: `(..., c)` readings (uT).
        noise: The sensor's errors with the steps.

    Returns:
        `(..., c)` rounded readings (uT).
    """
    channels = readings.shape[-1]
    steps = noise.steps(channels // 3).reshape((1,) * (readings.ndim - 1) + (channels,))
    safe = jnp.where(steps > 0, steps, 1)
    return jnp.where(steps > 0, jnp.round(readings / safe) * safe, readings)
