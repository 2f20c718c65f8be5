"""Health of a skin at rest: dead, frozen, saturated and noisy chips; and whether the skin responds to a press.

The functions judge samples that a skin sent while it touched nothing, and the change that a light press made. Each
defect is one sentence that names chip and axis. Defects that falsify readings stop a session (`stops`); defects that
only worsen them are reported. A chip that does not answer is missing (NaN in the readings): it is named, and stops a
session if fewer than half of the chips are left.

The expected noise is the board's own: the median over its chips of the same axis, but at least half of the noise of
real ReSkin boards (`HealthConfig.typical_noise_ut`). A channel is too noisy above three times that, or above 15 uT. The
noise is estimated from the differences of successive samples without their largest hundredth, so that neither a slow
field nor a step counts as noise. An axis is frozen if it did not change once, although the same axis of other chips
would have stayed unchanged with a probability of at most one in a million. An axis is saturated if it stays at its
largest value, near or beyond the end of the converter's smallest range.

Microtesla, board axes. NumPy only.
"""

import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.protocols import Samples, Skin
from i2t.skin.boards import mean_finite, silent_chips
from i2t.types import Array

# uT along x, y and z, smallest range of the MLX90393's converter in either direction. Its data sheet gives 2^15 steps
# of 0.150 uT along x and y and of 0.242 uT along z at the finest settings. A value that stays
# near or beyond this range counts as saturated.
CONVERTER_RANGE_UT = (4915.0, 4915.0, 7930.0)


@dataclass(frozen=True)
class HealthConfig:
    """Duration and number of a skin's samples at rest, and thresholds by which they and a press are judged.

    The thresholds are of noise (uT), frozen and saturated values, missing chips, and the response (uT) to a press. The
    typical noise was recorded on ReSkin boards at rest, at the paper's settings.
    """

    rest_duration: float = 0.5  # s, duration of the samples at rest, once there are `min_samples`
    rest_samples: int = 200  # number of samples at rest that suffice even in less time than `rest_duration`
    min_samples: int = 24  # smallest number of samples that a judgement needs
    samples_per_read: int = 8  # number of samples per read; few, so that a board of some hertz is judged too
    read_timeout: float = 3.0  # s, waiting time for the samples of a read
    # uT, typical standard deviation of a sample along x, y and z
    typical_noise_ut: tuple[float, float, float] = (3.1, 3.1, 4.6)
    noise_factor: float = 3.0  # factor on the typical noise above which a chip is too noisy
    max_noise_ut: float = 15.0
    glitch_share: float = 0.01  # share of the differences, the largest ones, that are left out of the noise
    # probability of an unchanged axis by chance, below which the axis counts as frozen
    frozen_probability: float = 1e-6
    saturation_share: float = 0.98  # share of the converter's range from which a value counts as saturated
    clipped_share: float = 0.3  # share of the samples at the largest value that means saturation
    min_chip_share: float = 0.5  # smallest share of the chips that must answer
    min_response_ut: float = 4.0  # uT, smallest reading of a press, even on a flat; noise alone stays below
    min_press_force: float = 1.5  # N, smallest force of a press that must change the reading


class SkinDefect(NamedTuple):
    """A sentence on something wrong with a skin's samples, and whether that stops a session from starting."""

    sentence: str
    stops: bool  # whether the defect prevents a session from starting


class SkinHealth(NamedTuple):
    """Rate (Hz), noise (uT), temperatures (degrees Celsius), missing chips and defects of a skin, from samples at rest.

    The noise is the standard deviation of one sample of each channel.
    """

    rate: float  # Hz, rate of the samples
    noise: Float[np.ndarray, " c"]  # uT, standard deviation of one sample; NaN for a missing chip
    temperature: Float[np.ndarray, " chips"]  # degrees Celsius; NaN if the skin does not report it
    missing: tuple[int, ...]  # numbers of the chips that did not answer
    defects: tuple[SkinDefect, ...]

    @property
    def summary(self) -> str:
        """One line of text with the skin's rate, noise, temperature and missing chips."""
        noise = self.noise[np.isfinite(self.noise)]
        parts = [f"{self.rate:.0f} Hz", f"noise up to {noise.max():.1f} uT" if len(noise) else "no chip answers"]
        celsius = self.temperature[np.isfinite(self.temperature)]
        limits = dict.fromkeys(f"{limit:.1f}" for limit in (celsius.min(), celsius.max())) if len(celsius) else ()
        parts += [f"{' to '.join(limits)} C"] if limits else []
        return ", ".join(parts) + (f"; without {_chips(self.missing)}" if self.missing else "")


def rest_samples(skin: Skin, clock: Clock | None = None, *, config: HealthConfig = HealthConfig()) -> Samples:
    """Read samples of a skin that touches nothing, for `check_skin`.

    Args:
        skin: Connected skin.
        clock: Clock of the skin; by default this machine's.
        config: Duration and number of the samples.

    Returns:
        Samples of half a second, or the first 200 if they come sooner; at least 24 rows, however slow the board.

    Raises:
        DeviceError: The skin is silent.
    """
    clock = MonotonicClock() if clock is None else clock
    parts, start = [skin.read(config.samples_per_read, config.read_timeout)], clock.now()
    count = config.samples_per_read
    while count < config.min_samples or (count < config.rest_samples and clock.now() - start < config.rest_duration):
        parts.append(skin.read(config.samples_per_read, config.read_timeout))
        count += config.samples_per_read
    return Samples(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def check_skin(samples: Samples, *, config: HealthConfig = HealthConfig()) -> SkinHealth:
    """Judge the health of a skin from samples that it sent while it touched nothing.

    Args:
        samples: Samples from `rest_samples`: 24 rows or more.
        config: Thresholds of the judgement.

    Returns:
        The health of the skin, with its defects.
    """
    reading = np.asarray(samples.reading, float)
    by_chip = reading.reshape(len(reading), -1, 3)
    missing = tuple(int(chip) for chip in np.flatnonzero(~np.isfinite(by_chip).all(2).any(0)))
    temperature = mean_finite(np.asarray(samples.temperature, float), axis=0)
    dead = np.tile(silent_chips(reading).mean(0) > 0.5, (3, 1)).T
    saturated = _saturated(by_chip, config) & ~dead
    frozen = _frozen(by_chip, config) & ~dead & ~saturated
    noise = _white_noise(by_chip, config)
    judged_noise = np.where(dead | saturated | frozen, np.nan, noise)
    at_rest = np.nan_to_num(mean_finite(by_chip, axis=0))
    defects = [
        *_missing_defects(missing, by_chip.shape[1], config),
        *_axis_defects(dead, "sends zeros only", remedy="check its cable and its soldering"),
        *_axis_defects(saturated, "is at the end of its range", at_rest, "take the magnet away, or lower the gain"),
        *_axis_defects(frozen, "stands still", at_rest, "check its cable and its soldering, and reset the board"),
        *_noise_defects(judged_noise, config),
    ]
    span = float(samples.time[-1] - samples.time[0])
    rate = (len(reading) - 1) / span if span > 0 else float("nan")
    return SkinHealth(rate, noise.ravel(), temperature, missing, tuple(defects))


def press_defect(change: Float[Array, " c"], force: float, *, config: HealthConfig = HealthConfig()) -> str:
    """Check that a skin responded to a light press.

    Args:
        change: (c,) change of the reading in uT; NaN for a missing chip.
        force: Force of the press in N.
        config: Thresholds of force and response.

    Returns:
        A sentence on the defect if the skin did not respond; empty if it did, or if the force is below
        `config.min_press_force`.
    """
    size = float(np.sqrt(np.nansum(np.asarray(change, float) ** 2)))
    if force < config.min_press_force or size >= config.min_response_ut:
        return ""
    return (
        f"a press of {force:.1f} N changed its reading by {size:.1f} uT, less than {config.min_response_ut:g}: "
        "the elastomer is missing or not magnetised, or something other than the skin was pressed"
    )


def frozen_sentence(reading: Float[Array, "n c"], *, config: HealthConfig = HealthConfig()) -> str:
    """Check during a session that a skin's values still change; a frozen skin would feel no contact.

    Args:
        reading: (n, c) successive samples in uT, with the noise of a real skin; NaN for a missing chip.
        config: Number of samples that the judgement needs.

    Returns:
        A sentence on the defect if no chip changed once in 24 samples or more, otherwise an empty string.
    """
    by_chip = np.asarray(reading, float).reshape(len(reading), reading.shape[1] // 3, 3)
    by_chip = by_chip[:, np.isfinite(by_chip).all(2).sum(0) >= config.min_samples]
    if not by_chip.shape[1] or not _frozen(by_chip, config).all():
        return ""
    return f"its readings did not change once in {len(by_chip)} samples: it is frozen; reset the board, check its cable"


def _white_noise(by_chip: Array, config: HealthConfig) -> np.ndarray:
    """White noise (chips, 3) of one sample in uT, without slow changes; NaN for a missing chip."""
    change = np.abs(np.diff(by_chip, axis=0))
    noise = np.full(by_chip.shape[1:], np.nan)
    for chip, axis in np.ndindex(*noise.shape):
        sizes = np.sort(change[:, chip, axis][np.isfinite(change[:, chip, axis])])
        kept = sizes[: len(sizes) - int(np.ceil(config.glitch_share * len(sizes)))]
        if len(kept) >= config.min_samples // 2:
            noise[chip, axis] = np.sqrt(np.mean(kept**2) / 2)
    return noise


def _saturated(by_chip: Array, config: HealthConfig) -> np.ndarray:
    """Mask (chips, 3) of axes that stay at their largest value, near or beyond the converter's smallest range."""
    size = np.abs(np.where(np.isfinite(by_chip), by_chip, 0.0))
    largest = size.max(0)
    clipped = (size == largest).mean(0) > config.clipped_share
    return clipped & (largest >= config.saturation_share * np.array(CONVERTER_RANGE_UT))


def _frozen(by_chip: Array, config: HealthConfig) -> np.ndarray:
    """Mask (chips, 3) of axes that did not change once, although the same axes of other chips did."""
    change = np.diff(by_chip, axis=0)
    count = np.isfinite(change).sum(0)
    moved = ((change != 0) & np.isfinite(change)).sum(0)
    still = (count >= config.min_samples // 2) & (moved == 0)
    if still[count > 0].all():
        return still  # the whole board
    moved_share = np.where((count > 0) & ~still, moved / np.maximum(count, 1), np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of an axis that stands still on every chip
        usual = np.nanmedian(moved_share, axis=0)
    usual = np.where(np.isnan(usual), np.nanmedian(moved_share), usual)
    return still & ((1 - usual) ** count < config.frozen_probability)


def _missing_defects(missing: tuple[int, ...], chips: int, config: HealthConfig) -> list[SkinDefect]:
    left = chips - len(missing)
    if left >= config.min_chip_share * chips:
        return []
    return [SkinDefect(f"only {left} of {chips} chips answer, without {_chips(missing)}; check the cables", True)]


def _axis_defects(mask: np.ndarray, what: str, at: np.ndarray | None = None, remedy: str = "") -> list[SkinDefect]:
    """Defects of the axes in a mask (chips, 3): one for the whole board, or one for each chip."""
    if mask.all() and len(mask) > 1:
        return [SkinDefect(f"every chip {what}; {remedy}", True)]
    defects = []
    for chip in np.flatnonzero(mask.any(1)):
        along = ", ".join("xyz"[axis] for axis in np.flatnonzero(mask[chip]))
        values = "" if at is None else f", at {', '.join(f'{value:.1f}' for value in at[chip][mask[chip]])} uT"
        defects.append(SkinDefect(f"chip {chip} {what} along {along}{values}; {remedy}", True))
    return defects


def _noise_defects(noise: np.ndarray, config: HealthConfig) -> list[SkinDefect]:
    typical = np.array(config.typical_noise_ut)
    own = np.array([np.nanmedian(column) if np.isfinite(column).any() else 0.0 for column in noise.T])
    limit = np.minimum(config.max_noise_ut, config.noise_factor * np.maximum(own, typical / 2))
    sentence = "chip {}'s {} has {:.1f} uT of noise, above {:.1f}; look for a loose cable, or a motor near it"
    noisy = np.argwhere(noise > limit)  # False for NaN
    return [SkinDefect(sentence.format(i, "xyz"[axis], noise[i, axis], limit[axis]), False) for i, axis in noisy]


def _chips(numbers: tuple[int, ...]) -> str:
    return ", ".join(f"chip {number}" for number in numbers)
