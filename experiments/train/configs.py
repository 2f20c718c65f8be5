"""Settings and presets of the experiment, as frozen dataclasses without arrays."""

import math
from dataclasses import dataclass, field

from experiments.train.arguments import Registration
from i2t.paper.config import PaperOptions
from i2t.prediction.methods import METHODS
from i2t.simulation.touches import PressLimits, SimulationErrors
from i2t.skin.contact import FINE_GRID
from i2t.training import TrainConfig

FORCE_METHODS = ("paper-mask-force", "paper-depth-force")  # the paper's networks with the measured force, for studies


@dataclass(frozen=True)
class Simulation:
    """Objects, numbers of touches and errors of the simulated data set."""

    train: tuple[str, ...] = ("hexagon", "parallelogram")  # as in the paper
    validation: tuple[str, ...] = ("cutter",)
    test: tuple[str, ...] = ("star", "square", "flower", "cylinder", "screwdriver", "hammer")
    selection: tuple[str, ...] = ()  # more objects to choose the method by, touched last, as often as a test object
    touches: int = 1630  # of all objects without those of `selection`, as in the paper
    train_share: float = 0.575  # share of the touches on training objects: 13 sessions of 36 touches on each
    touches_per_session: int = 36  # as in the paper
    same_camera: bool = False  # whether one camera calibration holds for all sessions
    errors: SimulationErrors = field(default_factory=SimulationErrors)
    limits: PressLimits = field(default_factory=lambda: PressLimits(final=FINE_GRID))

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of all objects in the order in which they are touched, training objects first."""
        return self.train + self.validation + self.test + self.selection

    def counts(self) -> list[int]:
        """Compute the number of touches of each object. Without the objects of `selection` they sum to `touches`."""
        training = round(self.touches * self.train_share)
        others = _divide(self.touches - training, len(self.validation + self.test))
        return _divide(training, len(self.train)) + others + others[:1] * len(self.selection)


def _divide(total: int, parts: int) -> list[int]:
    return [total // parts + (i < total % parts) for i in range(parts)]


@dataclass(frozen=True)
class TrainExperiment:
    """Settings of `python -m experiments.train`."""

    simulation: Simulation = field(default_factory=Simulation)
    methods: tuple[str, ...] = tuple(name for name in METHODS if name not in FORCE_METHODS)
    training: TrainConfig = field(default_factory=lambda: TrainConfig(epochs=120))
    pads: tuple[int, ...] = (0,)  # seeds of the simulated pads
    seeds: int = 1
    split: str = "auto"  # what is held out of a recording: object, session, block or time
    registered: Registration | None = None  # how registration of known objects corrects the touches
    softness: float = 1.0  # of the skin, relative to the nominal skin
    paper: PaperOptions = field(default_factory=PaperOptions)  # options of the paper's network
    hidden_tilt: float = 0.4 * math.pi / 180  # rad, uncertainty of the tilt in a noisy view
    block: float = 6e-3  # m, edge of the spatial blocks in which presses on one object are held out


PRESETS: dict[str, TrainExperiment] = {
    "paper": TrainExperiment(),
    "debug": TrainExperiment(
        simulation=Simulation(
            train=("hexagon", "parallelogram"),
            validation=("marker",),
            test=("star", "hammer"),
            touches=60,
            train_share=0.6,
            touches_per_session=12,
            limits=PressLimits(),
        ),
        methods=tuple(name for name in METHODS if name not in (*FORCE_METHODS, "paper-mask", "pressure-network")),
        training=TrainConfig(epochs=12, batch_size=16),
    ),
    "study": TrainExperiment(
        # The 99 touches of one validation object are too few to choose a method. Recognition also validates on these
        # four objects.
        simulation=Simulation(selection=("pentagon", "octagon", "marker", "pliers")),
        methods=tuple(METHODS),
        pads=tuple(range(6)),
        # No early stopping, as for the networks of the paper's episodes (docs/recognition.md).
        training=TrainConfig(epochs=120, patience=120),
    ),
}
