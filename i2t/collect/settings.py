"""Settings of a touch, without NumPy, so that a command line shows them at once."""

from dataclasses import dataclass
from typing import Annotated

from i2t.cli.options import Limits, check_options
from i2t.patches.dimensions import MAX_SKIN_FORCE_N


@dataclass(frozen=True)
class TouchSettings:
    """Settings of a touch. Raises ValueError for numbers that make no sense.

    The speed of a press is what keeps it near its limits: at k N/m, t seconds late and braking with a, it runs
    k (v t + v^2 / 2a) past them; 10 N/mm, 60 ms and 2 mm/s give 1.2 N. The paper presses in steps; here the motion is
    one, watched all the time.
    """

    prepare: Annotated[float, Limits(2e-3, 0.3)] = 40e-3  # m before the site
    # m before the site, where the quick approach ends and the ambient is taken (paper: 10 mm)
    near: Annotated[float, Limits(2e-4, 0.3)] = 5e-3
    overtravel: Annotated[float, Limits(1e-4, 0.1)] = 6e-3  # m past the site, after which a press has met air
    skin_change: Annotated[float, Limits(1, 1e4)] = 25.0  # uT, norm of the change of a reading
    # of it must differ between chips: a change that all chips see alike is the room's
    nonuniform_share: Annotated[float, Limits(0, 1)] = 0.5
    # samples; one alone is 25 uT off in two of a thousand
    averaged_samples: Annotated[int, Limits(1, 1000)] = 10
    force: Annotated[float, Limits(0.2, MAX_SKIN_FORCE_N)] = 8.0  # N; the paper's recognition has 7
    torque: Annotated[float, Limits(0.05, 50)] = 8.0  # Nm
    ambient: Annotated[int, Limits(1, 1000)] = 10  # samples
    contact: Annotated[int, Limits(1, 1000)] = 10  # samples
    # m/s in the air, at the most: the force limit may allow less
    speed: Annotated[float, Limits(1e-3, 1)] = 0.15
    approach: Annotated[float, Limits(1e-4, 0.2)] = 0.02  # m/s
    press: Annotated[float, Limits(1e-4, 0.05)] = 0.002  # m/s
    retreat: Annotated[float, Limits(1e-3, 1)] = 0.05  # m/s, at the most, as in the air
    acceleration: Annotated[float, Limits(0.01, 5)] = 0.3  # m/s^2
    settle: Annotated[float, Limits(0, 10)] = 0.2  # s that the arm swings, before it looks or zeroes
    hold: Annotated[float, Limits(0, 10)] = 0.05  # s from the stop to the samples in contact
    clearance: Annotated[float, Limits(5e-3, 1)] = 0.1  # m above the object's highest point, on the way across
    # of the patch's pixels, that the camera must have measured
    min_visible_share: Annotated[float, Limits(0, 1)] = 0.5
    # m that the camera may see the surface before the site
    surface_tolerance: Annotated[float, Limits(5e-4, 0.05)] = 5e-3
    # m that the camera may see the surface before the end of a press that met nothing
    air_tolerance: Annotated[float, Limits(5e-4, 0.05)] = 3e-3
    silence: Annotated[float, Limits(0.02, 5)] = 0.15  # s without a sample, after which a press ends
    retries: Annotated[int, Limits(0, 100)] = 2  # attempts of a touch that failed
    failures: Annotated[int, Limits(1, 1000)] = 3  # sites in a row that fail, after which a person is asked
    patience: Annotated[float, Limits(0, 600)] = 10.0  # s, for a device that has to be connected again

    def __post_init__(self) -> None:
        check_options(self, group="settings.")
        if self.near > self.prepare:
            raise ValueError(
                f"settings.near, {self.near:g} m, lies before prepare, {self.prepare:g} m; make it smaller"
            )
