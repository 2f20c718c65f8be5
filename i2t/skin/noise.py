"""Sensor errors added to the field: white noise, a slow ambient field, steps of the converter.

A chip's sample is `quantise(field + ambient + white)`; a reading is the mean of the samples in contact minus the mean
of the samples before it. Sizes come from recordings of real ReSkin boards at rest with the paper's settings (MLX90393,
gain 7, resolution 0, oversampling 0, filter 2): 3.1 uT (x, y) and 4.6 uT (z) in one sample, 20-33 % of that variance
one slow field that all chips share once turned to common axes, steps of 0.150 and 0.242 uT, drifts of 1-15 uT over a
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
    """Sizes of the sensor's errors (uT); zero switches one off."""

    xy: float = 3.1  # standard deviation of one sample at rest, each of x and y
    z: float = 4.6  # and of z
    common: float = 0.26  # part of that variance that is the slow ambient field
    step_xy: float = 0.150  # of the converter
    step_z: float = 0.242
    ambient_samples: int = 10  # averaged before contact, as in the paper
    contact_samples: int = 10  # and in contact

    @classmethod
    def none(cls) -> "Noise":
        """An ideal sensor."""
        return cls(xy=0.0, z=0.0, common=0.0, step_xy=0.0, step_z=0.0)

    def scaled(self, factor: float) -> "Noise":
        """The same sensor with more or less noise; its steps stay.

        Args:
            factor: Of the noise.

        Returns:
            The new noise.
        """
        return replace(self, xy=factor * self.xy, z=factor * self.z)

    def sigma(self, chips: int) -> Float[Any, " c"]:
        """Standard deviation of one sample at rest.

        Args:
            chips: Of the board.

        Returns:
            (3 chips,) uT.
        """
        return _of_axes(self.xy, self.z, chips)

    def steps(self, chips: int) -> Float[Any, " c"]:
        """Steps of the converter.

        Args:
            chips: Of the board.

        Returns:
            (3 chips,) uT.
        """
        return _of_axes(self.step_xy, self.step_z, chips)


def _of_axes(xy: Any, z: Any, chips: int) -> Float[Any, " c"]:
    """A value of each axis of each chip: NumPy's of numbers, JAX's where one is traced."""
    xp = jnp if isinstance(xy, jax.Array) or isinstance(z, jax.Array) else np
    return xp.tile(xp.array([xy, xy, z]), chips)


def add_sensor_noise(
    key: Key[Array, ""], reading: Float[Array, " c"], board: Board, noise: Noise | None = None
) -> Float[Array, " c"]:
    """A touch as it is recorded: mean of the samples in contact minus mean of the samples before it.

    The slow field is taken as constant within a burst of samples (25 ms for 10 at 400 Hz) and drawn afresh for the next
    (a press later), so averaging more samples does not remove it. Drift within one touch is far smaller and left out.

    Args:
        key: random key.
        reading: uT, of an ideal sensor.
        board: whose chips read it.
        noise: sizes of the errors, by default those of real boards.

    Returns:
        The reading in uT.
    """
    noise = Noise() if noise is None else noise
    key_contact, key_ambient = jax.random.split(key)
    contact = sample_burst(key_contact, reading, board, noise, noise.contact_samples)
    rest = sample_burst(key_ambient, jnp.zeros_like(reading), board, noise, noise.ambient_samples)
    return jnp.mean(contact, axis=0) - jnp.mean(rest, axis=0)


def sample_burst(
    key: Key[Array, ""], reading: Float[Array, " c"], board: Board, noise: Noise, samples: int
) -> Float[Array, "s c"]:
    """Raw samples, quick enough after one another that only the white noise differs between them.

    Args:
        key: random key.
        reading: uT, of an ideal sensor.
        board: whose chips read it.
        noise: sizes of the errors.
        samples: how many.

    Returns:
        Samples in uT.
    """
    key_ambient, key_white = jax.random.split(key)
    field = reading + ambient(key_ambient, board, noise)
    sigma = noise.sigma(board.num_chips)[None]
    own = sigma * jnp.sqrt(1 - noise.common) * jax.random.normal(key_white, (samples, board.num_readings))
    return quantise(field[None] + own, noise)


def ambient(key: Key[Array, ""], board: Board, noise: Noise) -> Float[Array, " c"]:
    """The slow ambient field at one moment: one vector in tool axes, seen by every chip in its own.

    Args:
        key: random key.
        board: whose chips see it.
        noise: sizes of the errors.

    Returns:
        A reading in uT.
    """
    field = jnp.sqrt(noise.common) * noise.sigma(1) * jax.random.normal(key, (3,))
    return board.to_board(jnp.broadcast_to(field, (board.num_chips, 3)))


def quantise(readings: Float[Array, "*n c"], noise: Noise) -> Float[Array, "*n c"]:
    """Readings rounded to the converter's steps.

    Args:
        readings: uT.
        noise: whose steps.

    Returns:
        Readings in uT.
    """
    channels = readings.shape[-1]
    steps = noise.steps(channels // 3).reshape((1,) * (readings.ndim - 1) + (channels,))
    safe = jnp.where(steps > 0, steps, 1)
    return jnp.where(steps > 0, jnp.round(readings / safe) * safe, readings)
