"""Safety limits of touch sites, without JAX, so that command lines can offer them."""

from dataclasses import dataclass

from i2t.windows import PAD_WINDOW

SITE_RANGES = {  # the least and the greatest of each that make sense, and the unit
    "min_cos": (-1.0, 1.0, ""),
    "max_rise": (0.0, 0.1, "m"),
    "half": (1e-3, 0.1, "m"),
    "mount": (0.0, 0.5, "m"),
    "flange": (0.0, 0.5, "m"),
    "flange_near": (0.0, 0.5, "m"),
    "flange_far": (0.0, 0.5, "m"),
    "table": (-1.0, 1.0, "m"),
    "clearance": (0.0, 0.1, "m"),
}


@dataclass(frozen=True)
class SiteLimits:
    """Limits of a safe site; by default as in the paper's collection, with a fair guess of a UR flange and mount."""

    min_cos: float = 0.25  # of the angle between normal and up; the paper's recognition uses 0.5
    max_rise: float = 3e-3  # m, of any surface above the contact plane inside the square
    half: float = PAD_WINDOW / 2  # m, half edge of the sensor's square
    mount: float = PAD_WINDOW  # m, edge of the square bar that carries the skin, from the skin back to the flange
    flange: float = 75e-3  # m, edge of the square box around flange and wrist
    flange_near: float = 30e-3  # m, where that box begins behind the skin
    flange_far: float = 100e-3  # m, and where it ends
    table: float = 0.0  # m, height of the table in W
    clearance: float = 1e-3  # m, that mount and flange keep above the table


def check_site_limits(limits: SiteLimits) -> None:
    """Refuse limits that make no sense of a lab.

    Args:
        limits: As given.

    Raises:
        ValueError: One of them is out of its range.
    """
    for name, (least, most, unit) in SITE_RANGES.items():
        value = getattr(limits, name)
        if not least <= value <= most:
            raise ValueError(f"sites.{name} is {value:g}; give {f'{least:g} to {most:g} {unit}'.strip()}")
    if limits.flange_far < limits.flange_near:
        raise ValueError(f"sites.flange_far, {limits.flange_far:g} m, lies before sites.flange_near; make it larger")
