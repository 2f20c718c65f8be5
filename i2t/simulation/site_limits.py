"""Safety limits of touch sites. This module does not import JAX, so that command lines can offer them."""

from dataclasses import dataclass
from typing import Annotated, get_type_hints

from i2t.cli.options import Limits
from i2t.patches.dimensions import PAD_WINDOW


@dataclass(frozen=True)
class SiteLimits:
    """Limits of a safe site: slope, rise of the surface around it, and clearance of mount and flange above the table.
    The defaults are those of the paper's collection, with estimates for a UR flange and mount.

    Raises:
        ValueError: A limit is outside its range, or the flange's box ends before it begins.

    Example:
        limits = i2t.SiteLimits(min_cos=0.5, table=-0.02)  # flatter places on an object on a block
        sites = i2t.sample_touch_sites(mesh, 36, limits=limits)
    """

    # smallest cosine of the angle between the surface normal and the vertical; the paper's recognition uses 0.5
    min_cos: Annotated[float, Limits(-1, 1)] = 0.25
    # largest height (m) of a surface above the contact plane within the sensor's square
    max_rise: Annotated[float, Limits(0, 0.1)] = 3e-3
    half_edge: Annotated[float, Limits(1e-3, 0.1)] = PAD_WINDOW / 2  # half the edge (m) of the sensor's square
    # edge (m) of the square bar that connects the skin to the flange
    mount: Annotated[float, Limits(0, 0.5)] = PAD_WINDOW
    flange: Annotated[float, Limits(0, 0.5)] = 75e-3  # edge (m) of the square box around flange and wrist
    # distance (m) from the skin back to the front of the flange's box
    flange_near: Annotated[float, Limits(0, 0.5)] = 30e-3
    # distance (m) from the skin back to the rear of the flange's box
    flange_far: Annotated[float, Limits(0, 0.5)] = 100e-3
    table: Annotated[float, Limits(-1, 1)] = 0.0  # height (m) of the table in the world
    clearance: Annotated[float, Limits(0, 0.1)] = 1e-3  # smallest distance (m) of mount and flange from the table

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            value, (limits,) = getattr(self, name), hint.__metadata__
            if not limits.allow(value):
                raise ValueError(f"sites.{name}, {value!r}, must be {limits}")
        if self.flange_far < self.flange_near:
            raise ValueError(f"sites.flange_far, {self.flange_far:g} m, lies before sites.flange_near; make it larger")
