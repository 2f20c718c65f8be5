"""Health of a skin at rest: dead, frozen and saturated chips, noise; and whether it feels.

A pure judgement of samples that a skin sent while it touched nothing, and of the change that a light press made. Each
defect is one sentence that names chip and axis. What makes readings a lie stops a session (`stops`); what makes them
worse is said. A chip that does not answer is missing (NaN), which readings say themselves: it is named, and stops a
session where less than half of the chips are left.

Which noise is to be expected is the board's own: the median over its chips of the same axis, but at least half of that
of real ReSkin boards at the paper's settings (3.1 uT along x and y, 4.6 uT along z, recorded at rest). A channel is too
noisy above three times that, or above 15 uT. Noise is measured from the differences of successive samples without their
largest hundredth, so that a slow field or a step is no noise. An axis is frozen that did not change once, where the
same axis of other chips would have done so with a probability of one in a million at the most. It is saturated where
it stays at its greatest value, beyond the least end of the converter's range (MLX90393 data sheet: 2^15 steps of 0.150
uT along x and y and 0.242 uT along z at the finest settings).

Microtesla, board axes. NumPy only.
"""

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.protocols import Samples, Skin
from i2t.skin.boards import mean_known, silent_chips
from i2t.types import Array

HEALTH_REST_S, HEALTH_SAMPLES = 0.5, 200  # whichever of both comes first, after the least number
MIN_REST_SAMPLES = 24
READ_AT_ONCE, LISTEN_TIMEOUT_S = 8, 3.0  # so that a board of some hertz is judged too
TYPICAL_NOISE_UT = (3.1, 3.1, 4.6)  # of one sample of a real ReSkin board at rest, x, y, z
NOISE_FACTOR, MAX_NOISE_UT = 3.0, 15.0
GLITCH_SHARE = 0.01  # of the largest differences, that are glitches and no noise
FROZEN_CHANCE = 1e-6
CONVERTER_END_UT = (4915.0, 4915.0, 7930.0)  # least range of a converter, either way
END_SHARE, CLIPPED_SHARE = 0.98, 0.3  # of that range; of the samples that are at the greatest value
MIN_CHIP_SHARE = 0.5  # of the chips, that must answer
LEAST_RESPONSE_UT = 4.0  # of a reading, to a press of the least force, also of a flat; noise alone is below
LEAST_PRESS_N = 1.5


class SkinDefect(NamedTuple):
    """One thing that is wrong with a skin."""

    sentence: str
    stops: bool  # no session may start on it


class SkinHealth(NamedTuple):
    """Health of a skin by its samples at rest."""

    rate: float  # Hz
    noise: Float[np.ndarray, " c"]  # uT, standard deviation of one sample; NaN for a chip that is missing
    temperature: Float[np.ndarray, " chips"]  # degrees Celsius; NaN where the skin does not tell
    missing: tuple[int, ...]  # chips that did not answer
    defects: tuple[SkinDefect, ...]

    @property
    def summary(self) -> str:
        """Rate, noise, temperature and missing chips, for a person."""
        known = self.noise[np.isfinite(self.noise)]
        parts = [f"{self.rate:.0f} Hz", f"noise up to {known.max():.1f} uT" if len(known) else "no chip answers"]
        warmth = self.temperature[np.isfinite(self.temperature)]
        parts += [f"{warmth.min():.1f} to {warmth.max():.1f} C"] if len(warmth) else []
        return ", ".join(parts) + (f"; without {_chips(self.missing)}" if self.missing else "")


def rest_samples(skin: Skin, clock: Clock | None = None) -> Samples:
    """Samples of a skin that touches nothing, for half a second, or until a slow board has sent enough.

    Args:
        skin: Connected.
        clock: In whose time it lives; by default this machine's.

    Returns:
        At least 24 rows.

    Raises:
        DeviceError: It is silent.
    """
    clock = MonotonicClock() if clock is None else clock
    parts, begun = [skin.read(READ_AT_ONCE, LISTEN_TIMEOUT_S)], clock.now()
    count = READ_AT_ONCE
    while count < MIN_REST_SAMPLES or (count < HEALTH_SAMPLES and clock.now() - begun < HEALTH_REST_S):
        parts.append(skin.read(READ_AT_ONCE, LISTEN_TIMEOUT_S))
        count += READ_AT_ONCE
    return Samples(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def check_skin(samples: Samples) -> SkinHealth:
    """Judge samples of a skin that touched nothing.

    Args:
        samples: As of `rest_samples`: 24 rows or more.

    Returns:
        What they tell.
    """
    reading = np.asarray(samples.reading, float)
    by_chip = reading.reshape(len(reading), -1, 3)
    missing = tuple(int(chip) for chip in np.flatnonzero(~np.isfinite(by_chip).all(2).any(0)))
    temperature = mean_known(np.asarray(samples.temperature, float), axis=0)
    dead = np.tile(silent_chips(reading).mean(0) > 0.5, (3, 1)).T
    saturated = _saturated(by_chip) & ~dead
    frozen = _frozen(by_chip) & ~dead & ~saturated
    noise = _white_noise(by_chip)
    heard = np.where(dead | saturated | frozen, np.nan, noise)
    at_rest = np.nan_to_num(mean_known(by_chip, axis=0))
    defects = [
        *_missing_defects(missing, by_chip.shape[1]),
        *_axis_defects(dead, "sends zeros and nothing else", remedy="check its cable and its solder"),
        *_axis_defects(saturated, "is at the end of its range", at_rest, "take the magnet away, or lower the gain"),
        *_axis_defects(frozen, "stands still", at_rest, "check its cable and its solder, and reset the board"),
        *_noise_defects(heard),
    ]
    span = float(samples.time[-1] - samples.time[0])
    rate = (len(reading) - 1) / span if span > 0 else float("nan")
    return SkinHealth(rate, noise.ravel(), temperature, missing, tuple(defects))


def press_defect(change: Float[Array, " c"], force: float) -> str:
    """Judge what a light press did to a reading.

    Args:
        change: (c,) uT, of the reading; NaN for a chip that is missing.
        force: N, of the press.

    Returns:
        A sentence if the skin felt nothing of it, else "".
    """
    size = float(np.sqrt(np.nansum(np.asarray(change, float) ** 2)))
    if force < LEAST_PRESS_N or size >= LEAST_RESPONSE_UT:
        return ""
    return (
        f"a press of {force:.1f} N changed its reading by {size:.1f} uT, less than {LEAST_RESPONSE_UT:g}: the "
        "elastomer is missing or not magnetised, or something else than the skin was pressed"
    )


def frozen_sentence(reading: Float[Array, "n c"]) -> str:
    """Judge samples in the midst of a session, where a skin that is frozen would feel no contact.

    Args:
        reading: (n, c) uT, successive samples with the noise of a real skin; NaN for a chip that is missing.

    Returns:
        A sentence if no chip changed once in 24 samples or more, else "".
    """
    by_chip = np.asarray(reading, float).reshape(len(reading), reading.shape[1] // 3, 3)
    by_chip = by_chip[:, np.isfinite(by_chip).all(2).sum(0) >= MIN_REST_SAMPLES]  # those that can be judged
    if not by_chip.shape[1] or not _frozen(by_chip).all():
        return ""
    return f"its readings did not change once in {len(by_chip)} samples: it is frozen; reset the board, check its cable"


def _white_noise(by_chip: Array) -> np.ndarray:
    """White noise (chips, 3) uT of one sample, without slow changes; NaN for a chip that is missing."""
    change = np.abs(np.diff(by_chip, axis=0))
    noise = np.full(by_chip.shape[1:], np.nan)
    for chip, axis in np.ndindex(*noise.shape):
        known = np.sort(change[:, chip, axis][np.isfinite(change[:, chip, axis])])
        kept = known[: len(known) - int(np.ceil(GLITCH_SHARE * len(known)))]
        if len(kept) >= MIN_REST_SAMPLES // 2:
            noise[chip, axis] = np.sqrt(np.mean(kept**2) / 2)
    return noise


def _saturated(by_chip: Array) -> np.ndarray:
    """Mask (chips, 3) of axes that stay at their greatest value, near or beyond the least end of a converter."""
    size = np.abs(np.where(np.isfinite(by_chip), by_chip, 0.0))
    greatest = size.max(0)
    clipped = (size == greatest).mean(0) > CLIPPED_SHARE
    return clipped & (greatest >= END_SHARE * np.array(CONVERTER_END_UT))


def _frozen(by_chip: Array) -> np.ndarray:
    """Mask (chips, 3) of axes that did not change once, though the other chips' say that they should have."""
    change = np.diff(by_chip, axis=0)
    known = np.isfinite(change).sum(0)
    moved = ((change != 0) & np.isfinite(change)).sum(0)
    still = (known >= MIN_REST_SAMPLES // 2) & (moved == 0)
    if still[known > 0].all():
        return still  # of the whole board
    moves = np.where((known > 0) & ~still, moved / np.maximum(known, 1), np.nan)  # share of the changes
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of an axis along which every chip stands still
        usual = np.nanmedian(moves, axis=0)
    usual = np.where(np.isnan(usual), np.nanmedian(moves), usual)
    return still & ((1 - usual) ** known < FROZEN_CHANCE)


def _missing_defects(missing: tuple[int, ...], chips: int) -> list[SkinDefect]:
    left = chips - len(missing)
    if left >= MIN_CHIP_SHARE * chips:
        return []
    return [SkinDefect(f"only {left} of {chips} chips answer, without {_chips(missing)}; check the cables", True)]


def _axis_defects(wrong: np.ndarray, what: str, at: np.ndarray | None = None, remedy: str = "") -> list[SkinDefect]:
    """Sentences on axes (chips, 3) that lie: of the whole board, or of chips."""
    if wrong.all() and len(wrong) > 1:
        return [SkinDefect(f"every chip {what}; {remedy}", True)]
    defects = []
    for chip in np.flatnonzero(wrong.any(1)):
        along = ", ".join("xyz"[axis] for axis in np.flatnonzero(wrong[chip]))
        values = "" if at is None else f", at {', '.join(f'{value:.1f}' for value in at[chip][wrong[chip]])} uT"
        defects.append(SkinDefect(f"chip {chip} {what} along {along}{values}; {remedy}", True))
    return defects


def _noise_defects(noise: np.ndarray) -> list[SkinDefect]:
    typical = np.array(TYPICAL_NOISE_UT)
    own = np.array([np.nanmedian(column) if np.isfinite(column).any() else 0.0 for column in noise.T])
    limit = np.minimum(MAX_NOISE_UT, NOISE_FACTOR * np.maximum(own, typical / 2))
    said = "chip {}'s {} has {:.1f} uT of noise, above {:.1f}; look for a loose cable, or a motor near it"
    loud = np.argwhere(noise > limit)  # False where it is NaN
    return [SkinDefect(said.format(i, "xyz"[axis], noise[i, axis], limit[axis]), False) for i, axis in loud]


def _chips(numbers: tuple[int, ...]) -> str:
    return ", ".join(f"chip {number}" for number in numbers)
