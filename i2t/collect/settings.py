"""Settings of a touch and of free poses, without NumPy, so that a command line shows them at once."""

from dataclasses import dataclass, field, fields
from typing import Any


def _ranged(default: float, least: float, most: float, unit: str = "") -> Any:
    """A field with the least and the greatest value that make sense, and their unit."""
    return field(default=default, metadata={"range": (least, most, unit)})


def _check_ranges(group: str, settings: Any) -> None:
    """Refuse a value that makes no sense; NaN never does."""
    for each in fields(settings):
        (least, most, unit), value = each.metadata["range"], getattr(settings, each.name)
        if not least <= value <= most:
            between = f"{least:g} to {most:g} {unit}".strip()
            raise ValueError(f"{group}.{each.name} is {value:g}; give {between}")


@dataclass(frozen=True)
class TouchSettings:
    """Settings of a touch. Raises ValueError for numbers that make no sense.

    The speed of a press is what keeps it near its limits: at k N/m, t seconds late and braking with a, it runs
    k (v t + v^2 / 2a) past them; 10 N/mm, 60 ms and 2 mm/s give 1.2 N. The paper presses in steps; here the motion is
    one, watched all the time.
    """

    prepare: float = _ranged(40e-3, 2e-3, 0.3, "m")  # m before the site
    # m before the site, where the quick approach ends and the ambient is taken (paper: 10 mm)
    near: float = _ranged(5e-3, 2e-4, 0.3, "m")
    overtravel: float = _ranged(6e-3, 1e-4, 0.1, "m")  # m past the site, after which a press has met air
    skin_change: float = _ranged(25.0, 1.0, 1e4, "uT")  # uT, norm of the change of a reading
    # of it must differ between chips: a change that all chips see alike is the room's
    nonuniform_share: float = _ranged(0.5, 0.0, 1.0)
    averaged_samples: int = _ranged(10, 1, 1000, "samples")  # samples; one alone is 25 uT off in two of a thousand
    force: float = _ranged(8.0, 0.2, 150.0, "N")  # N; the paper's recognition has 7
    torque: float = _ranged(8.0, 0.05, 50.0, "Nm")  # Nm
    ambient: int = _ranged(10, 1, 1000, "samples")  # samples
    contact: int = _ranged(10, 1, 1000, "samples")  # samples
    speed: float = _ranged(0.15, 1e-3, 1.0, "m/s")  # m/s in the air, at the most: the force limit may allow less
    approach: float = _ranged(0.02, 1e-4, 0.2, "m/s")  # m/s
    press: float = _ranged(0.002, 1e-4, 0.05, "m/s")  # m/s
    retreat: float = _ranged(0.05, 1e-3, 1.0, "m/s")  # m/s, at the most, as in the air
    acceleration: float = _ranged(0.3, 0.01, 5.0, "m/s^2")  # m/s^2
    settle: float = _ranged(0.2, 0.0, 10.0, "s")  # s that the arm swings, before it looks or zeroes
    hold: float = _ranged(0.05, 0.0, 10.0, "s")  # s from the stop to the samples in contact
    clearance: float = _ranged(0.1, 5e-3, 1.0, "m")  # m above the object's highest point, on the way across
    min_visible_share: float = _ranged(0.5, 0.0, 1.0)  # of the patch's pixels, that the camera must have measured
    surface_tolerance: float = _ranged(5e-3, 5e-4, 0.05, "m")  # m that the camera may see the surface before the site
    # m that the camera may see the surface before the end of a press that met nothing
    air_tolerance: float = _ranged(3e-3, 5e-4, 0.05, "m")
    silence: float = _ranged(0.15, 0.02, 5.0, "s")  # s without a sample, after which a press ends
    retries: int = _ranged(2, 0, 100, "attempts")  # of a touch that failed
    failures: int = _ranged(3, 1, 1000, "sites")  # sites in a row that fail, after which a person is asked
    patience: float = _ranged(10.0, 0.0, 600.0, "s")  # s, for a device that has to be connected again

    def __post_init__(self) -> None:
        _check_ranges("settings", self)
        if self.near > self.prepare:
            raise ValueError(
                f"settings.near, {self.near:g} m, lies before prepare, {self.prepare:g} m; make it smaller"
            )


@dataclass(frozen=True)
class AmbientSettings:
    """Free poses before a session, for the fit of the ambient field. Raises ValueError for what makes no sense."""

    poses: int = _ranged(0, 0, 1000, "poses")  # how many; a dozen is enough, 0 takes none
    # degrees, the farthest from pointing down; with more the flange would not stay above the skin
    tilt: float = _ranged(45.0, 10.0, 75.0, "degrees")
    turn: float = _ranged(90.0, 0.0, 90.0, "degrees")  # degrees, the farthest about the tool's axis, either way
    seconds: float = _ranged(2.0, 0.05, 60.0, "s")  # that the skin is read at each
    clearance: float = _ranged(0.05, 0.02, 1.0, "m")  # m above the height at which the tool goes across
    spread: float = _ranged(0.1, 0.0, 1.0, "m")  # m, edge of the cube in which the poses are

    def __post_init__(self) -> None:
        _check_ranges("ambient", self)
        if 0 < self.poses < 4:
            raise ValueError(f"ambient.poses is {self.poses}; give 0 for none, or at least 4, better 12")
