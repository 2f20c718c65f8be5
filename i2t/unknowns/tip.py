"""The radius of a spherical tip, from how the map of a skin blurs as the tip goes deeper.

A sphere of radius R at depth d touches a disk of radius a = sqrt(R d), and its pressure (Hertz) has the variance
a^2 / 5 along each axis. So the map at depth d is the map of a needle blurred by that variance, and two presses covary
as

    k(x, x') = l^2 / (l^2 + v) exp(-|x - x'|^2 / (2 (l^2 + v))),  v = R (d + d') / 5.

That is seen where the skin's map changes within the disk, and only there: on most skins any radius will do, which is
then said. NumPy only.
"""

import numpy as np

from i2t.unknowns.findings import Finding, RecordedPresses
from i2t.unknowns.smooth import left_out, thinned

TIP_RADIUS = "tip radius"
TIP_RADII_M = (0.3e-3, 1e-3, 2e-3, 4e-3, 8e-3, 16e-3)
TIP_PRESSES = 150
TIP_LENGTHS_M = (1.5e-3, 3e-3, 6e-3, 12e-3)
TIP_NOISES = (1e-3, 1e-2, 0.1)
TIP_TEMPERING = 20.0  # a value counts as a twentieth of an independent one, as the model is wrong in detail
TIP_DROP = 1.35  # of the tempered log density at the ends of a 90 % interval
TIP_FACTOR = 4.0  # between the ends of the interval: a wider one tells nothing


def find_tip_radius(presses: RecordedPresses, zero: float | None, stated: float | None = None) -> Finding:
    """Estimate the radius of the tip.

    Args:
        presses: With heights.
        zero: Height of first contact (m); None where it is not known.
        stated: The radius that is assumed (m), where one is.

    Returns:
        The finding; the estimate is in mm.
    """
    assumed = "" if stated is None else f"; {1e3 * stated:g} mm stays an assumption"
    if presses.height is None or zero is None:
        lacking = "depths are unknown" if presses.height is None else "these presses do not tell where contact begins"
        return Finding(TIP_RADIUS, f"The tip's radius is not identifiable: {lacking}{assumed}.", False)
    depth = np.maximum(zero - np.asarray(presses.height, np.float64), 0)
    deep = np.flatnonzero(depth > 0.1 * np.quantile(depth, 0.95))
    rows = deep[thinned(len(deep), TIP_PRESSES)]
    if len(rows) < 40 or presses.position[rows].std(0).min() < 1e-3:
        return Finding(TIP_RADIUS, f"The tip's radius is not identifiable: too few presses or places{assumed}.", False)
    chosen, depth = presses.rows(rows), depth[rows]
    square = ((chosen.position[:, None] - chosen.position[None]) ** 2).sum(-1)
    grown = np.outer(*2 * [(depth / np.mean(depth)) ** 1.6])
    values = chosen.readings / max(np.sqrt(np.mean(chosen.readings**2)), 1e-30)
    density = np.full(len(TIP_RADII_M), -np.inf)
    for i, radius in enumerate(TIP_RADII_M):
        blur = radius * (depth[:, None] + depth[None]) / 5
        for length in TIP_LENGTHS_M:
            wide = length**2 + blur
            signal = grown * length**2 / wide * np.exp(-square / (2 * wide))
            signal /= np.mean(np.diagonal(signal))
            for noise in TIP_NOISES:
                density[i] = max(density[i], left_out(signal + noise * np.eye(len(signal)), values).log_density)
    tempered = (density - density.max()) / TIP_TEMPERING
    inside = np.flatnonzero(tempered > -TIP_DROP)
    low, high = TIP_RADII_M[inside[0]], TIP_RADII_M[inside[-1]]
    best = TIP_RADII_M[int(np.argmax(density))]
    ends = inside[0] == 0 or inside[-1] == len(TIP_RADII_M) - 1
    evidence = {f"log_density_{1e3 * radius:g}_mm": value for radius, value in zip(TIP_RADII_M, tempered, strict=True)}
    if ends or high / low > TIP_FACTOR:
        which = f"radii from {1e3 * low:g} to {1e3 * high:g} mm explain the readings about as well"
        if inside[0] == 0:
            which = f"nothing larger than {1e3 * high:g} mm is seen, so that the skin hides the tip"
        sentence = f"The tip's radius is not identifiable: {which}{assumed}."
        return Finding(TIP_RADIUS, sentence, False, low=1e3 * low, high=1e3 * high, unit="mm", evidence=evidence)
    return Finding(
        TIP_RADIUS,
        f"The tip's radius is about {1e3 * best:g} mm (from {1e3 * low:g} to {1e3 * high:g}).",
        identifiable=True,
        wrong=bool(stated is not None and not low / 1.5 <= stated <= 1.5 * high),
        estimate=1e3 * best,
        low=1e3 * low,
        high=1e3 * high,
        unit="mm",
        evidence=evidence,
    )
