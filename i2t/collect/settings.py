"""Settings of a touch, without NumPy, so that a command line appears at once."""

from dataclasses import dataclass
from typing import Annotated

from i2t.cli.options import Limits, check_options
from i2t.patches.dimensions import MAX_SKIN_FORCE_N


@dataclass(frozen=True)
class TouchSettings:
    """Distances, speeds, limits and retries of a touch. Raises ValueError for implausible numbers.

    The speed v of a press limits its overrun: with stiffness k (N/m), a delay of t seconds and deceleration a, the
    force runs k (v t + v^2 / 2a) past its limit; 10 N/mm, 60 ms and 2 mm/s give 1.2 N. The paper presses in steps; here
    a press is one motion, watched all the time.
    """

    # distance (m) before the site from which the tool approaches it
    prepare: Annotated[float, Limits(2e-3, 0.3)] = 40e-3
    # distance (m) before the site at which the fast approach ends and the ambient field is measured; 0.01 in the paper
    near: Annotated[float, Limits(2e-4, 0.3)] = 5e-3
    # distance (m) past the site at which a press ends without contact
    overtravel: Annotated[float, Limits(1e-4, 0.1)] = 6e-3
    skin_change: Annotated[float, Limits(1, 1e4)] = 25.0  # change of the reading (norm, uT) that ends a press
    # fraction of --settings.skin-change that must be non-uniform across chips; a uniform change is due to a field of
    # the room
    nonuniform_share: Annotated[float, Limits(0, 1)] = 0.5
    # number of samples that are averaged before they are compared; a single sample is off by 25 uT in two of a thousand
    # cases
    averaged_samples: Annotated[int, Limits(1, 1000)] = 10
    # force (N) that ends a press; the paper's recognition uses 7
    force: Annotated[float, Limits(0.2, MAX_SKIN_FORCE_N)] = 8.0
    torque: Annotated[float, Limits(0.05, 50)] = 8.0  # torque (Nm) that ends a press
    ambient: Annotated[int, Limits(1, 1000)] = 10  # number of samples of the ambient field before contact
    contact: Annotated[int, Limits(1, 1000)] = 10  # number of samples of the reading in contact
    # maximum speed (m/s) in the air; the force limit may allow less
    speed: Annotated[float, Limits(1e-3, 1)] = 0.15
    approach: Annotated[float, Limits(1e-4, 0.2)] = 0.02  # speed (m/s) of the fast approach
    press: Annotated[float, Limits(1e-4, 0.05)] = 0.002  # speed (m/s) of a press
    retreat: Annotated[float, Limits(1e-3, 1)] = 0.05  # maximum speed (m/s) of retreats; the force limit may allow less
    acceleration: Annotated[float, Limits(0.01, 5)] = 0.3  # acceleration of all motions (m/s^2)
    # time (s) in which the arm settles before the camera looks or the force sensor is zeroed
    settle: Annotated[float, Limits(0, 10)] = 0.2
    hold: Annotated[float, Limits(0, 10)] = 0.05  # time (s) between the stop of a press and its samples in contact
    # height (m) of the tool above the object's highest point while it moves between sites
    clearance: Annotated[float, Limits(5e-3, 1)] = 0.1
    # fraction of the patch's pixels that the camera must have measured
    min_visible_share: Annotated[float, Limits(0, 1)] = 0.5
    # distance (m) before the site at which the camera may still see the surface
    surface_tolerance: Annotated[float, Limits(5e-4, 0.05)] = 5e-3
    # distance (m) before the end of a press without contact at which the camera may still see the surface
    air_tolerance: Annotated[float, Limits(5e-4, 0.05)] = 3e-3
    silence: Annotated[float, Limits(0.02, 5)] = 0.15  # time (s) without a sample of the skin after which a press ends
    retries: Annotated[int, Limits(0, 100)] = 2  # number of further attempts at a site after a touch has failed
    failures: Annotated[int, Limits(1, 1000)] = 3  # number of failed sites in a row after which the collection stops
    patience: Annotated[float, Limits(0, 600)] = 10.0  # time (s) in which a lost device may be connected again

    def __post_init__(self) -> None:
        check_options(self, group="settings.")
        if self.near > self.prepare:
            raise ValueError(
                f"settings.near, {self.near:g} m, is more than settings.prepare, {self.prepare:g} m; make it smaller"
            )
