"""Settings of a touch: the numbers of the procedure, without NumPy, so that a command line shows them at once."""

from dataclasses import dataclass

MAX_TILT_DEG, MAX_TURN_DEG = 75.0, 90.0  # of a free pose: the flange stays above the skin, its cable untwisted
SETTING_RANGES = {  # the least and the greatest of each that make sense, and the unit
    "prepare": (2e-3, 0.3, "m"),
    "near": (2e-4, 0.05, "m"),
    "overtravel": (1e-4, 0.03, "m"),
    "skin_change": (1.0, 1e4, "uT"),
    "nonuniform_share": (0.0, 1.0, ""),
    "averaged_samples": (1, 1000, "samples"),
    "force": (0.2, 150.0, "N"),
    "torque": (0.05, 50.0, "Nm"),
    "ambient": (1, 1000, "samples"),
    "contact": (1, 1000, "samples"),
    "speed": (1e-3, 1.0, "m/s"),
    "approach": (1e-4, 0.2, "m/s"),
    "press": (1e-4, 0.05, "m/s"),
    "retreat": (1e-3, 1.0, "m/s"),
    "acceleration": (0.01, 5.0, "m/s^2"),
    "settle": (0.0, 10.0, "s"),
    "hold": (0.0, 10.0, "s"),
    "clearance": (5e-3, 1.0, "m"),
    "min_visible_share": (0.0, 1.0, ""),
    "surface_tolerance": (5e-4, 0.05, "m"),
    "air_tolerance": (5e-4, 0.05, "m"),
    "silence": (0.02, 5.0, "s"),
    "retries": (0, 100, "attempts"),
    "failures": (1, 1000, "sites"),
    "patience": (0.0, 600.0, "s"),
}


@dataclass(frozen=True)
class TouchSettings:
    """Settings of a touch. Raises ValueError for numbers that make no sense.

    The speed of a press is what keeps it near its limits: at k N/m, t seconds late and braking with a, it runs
    k (v t + v^2 / 2a) past them; 10 N/mm, 60 ms and 2 mm/s give 1.2 N. The paper presses in steps; here the motion is
    one, watched all the time.
    """

    prepare: float = 40e-3  # m before the site
    near: float = 5e-3  # m before the site, where the quick approach ends and the ambient is taken (paper: 10 mm)
    overtravel: float = 6e-3  # m past the site, after which a press has met air (three extra steps of 2 mm)
    skin_change: float = 25.0  # uT, norm of the change of a reading
    nonuniform_share: float = 0.5  # of it must differ between chips: a change that all chips see alike is the room's
    averaged_samples: int = 10  # samples; one alone is 25 uT off in two of a thousand
    force: float = 8.0  # N; the paper's recognition has 7
    torque: float = 8.0  # Nm
    ambient: int = 10  # samples
    contact: int = 10  # samples
    speed: float = 0.15  # m/s in the air, at the most: what the force limit allows may be less
    approach: float = 0.02  # m/s
    press: float = 0.002  # m/s
    retreat: float = 0.05  # m/s, at the most, as in the air
    acceleration: float = 0.3  # m/s^2
    settle: float = 0.2  # s that the arm swings, before it looks or zeroes
    hold: float = 0.05  # s from the stop to the samples in contact
    clearance: float = 0.1  # m above the object's highest point, on the way across
    min_visible_share: float = 0.5  # of the patch's pixels, that the camera must have measured
    surface_tolerance: float = 5e-3  # m that the camera may see the surface before the site
    air_tolerance: float = 3e-3  # m that the camera may see the surface before the end of a press that met nothing
    silence: float = 0.15  # s without a sample, after which a press ends
    retries: int = 2  # of a touch that failed
    failures: int = 3  # sites in a row that fail, after which a person is asked
    patience: float = 10.0  # s, for a device that has to be connected again

    def __post_init__(self) -> None:
        for name, (least, most, unit) in SETTING_RANGES.items():
            value = getattr(self, name)
            if not least <= value <= most:
                between = f"{least:g} to {most:g} {unit}".strip()
                raise ValueError(f"settings.{name} is {value:g}; give {between}")
        if self.near > self.prepare:
            raise ValueError(
                f"settings.near, {self.near:g} m, lies before prepare, {self.prepare:g} m; make it smaller"
            )


@dataclass(frozen=True)
class AmbientSettings:
    """Free poses before a session, for the fit of the ambient field. Raises ValueError for what makes no sense."""

    poses: int = 0  # how many; a dozen is enough, 0 takes none
    tilt: float = 45.0  # degrees, the farthest from pointing down
    turn: float = 90.0  # degrees, the farthest about the tool's axis, either way
    seconds: float = 2.0  # that the skin is read at each
    clearance: float = 0.05  # m above the height at which the tool goes across
    spread: float = 0.1  # m, edge of the cube in which the poses are

    def __post_init__(self) -> None:
        for name, least, most in (
            ("poses", 0, 1000),
            ("tilt", 10.0, MAX_TILT_DEG),
            ("turn", 0.0, MAX_TURN_DEG),
            ("seconds", 0.05, 60.0),
            ("clearance", 0.02, 1.0),
            ("spread", 0.0, 1.0),
        ):
            value = getattr(self, name)
            if not least <= value <= most:
                raise ValueError(f"ambient.{name} is {value:g}; give {least:g} to {most:g}")
        if 0 < self.poses < 4:
            raise ValueError(f"ambient.poses is {self.poses}; give 0 for none, or at least 4, better 12")
