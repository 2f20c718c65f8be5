"""Named presets: frozen dataclasses that hold no arrays and say what an experiment does."""

import math
from dataclasses import dataclass, field

from experiments.train.arguments import Registration
from i2t.paper.config import PaperOptions
from i2t.prediction.methods import METHODS
from i2t.simulation.touches import PressLimits, SimulationErrors
from i2t.skin.contact import FINE_GRID
from i2t.training import TrainConfig

WITH_FORCE = ("paper-mask-force", "paper-depth-force")  # of a study: what the measured force is worth to the paper


@dataclass(frozen=True)
class Simulation:
    """The simulated data set: which objects, how many touches of each, what goes wrong."""

    train: tuple[str, ...] = ("hexagon", "parallelogram")  # the paper's
    validation: tuple[str, ...] = ("cutter",)
    test: tuple[str, ...] = ("star", "square", "flower", "cylinder", "screwdriver", "hammer")
    judging: tuple[str, ...] = ()  # more objects to choose the method by, touched last, as often as a test object
    touches: int = 1630  # the paper's, over all objects but these
    train_share: float = 0.575  # of the touches, on the training objects: 13 runs of 36 each
    touches_per_session: int = 36  # the paper's
    same_camera: bool = False  # whether the camera was calibrated once for all sessions, and not in each
    errors: SimulationErrors = field(default_factory=SimulationErrors)
    limits: PressLimits = field(default_factory=lambda: PressLimits(final=FINE_GRID))

    @property
    def objects(self) -> tuple[str, ...]:
        """All objects in the order in which they are touched, training objects first."""
        return self.train + self.validation + self.test + self.judging

    def counts(self) -> list[int]:
        """Touches of each object; without those of `judging` they sum to `touches`."""
        trained = round(self.touches * self.train_share)
        others = _shares(self.touches - trained, len(self.validation + self.test))
        return _shares(trained, len(self.train)) + others + others[:1] * len(self.judging)


def _shares(total: int, parts: int) -> list[int]:
    return [total // parts + (i < total % parts) for i in range(parts)]


@dataclass(frozen=True)
class TrainExperiment:
    """Settings of `python -m experiments.train`."""

    simulation: Simulation = field(default_factory=Simulation)
    methods: tuple[str, ...] = tuple(name for name in METHODS if name not in WITH_FORCE)
    training: TrainConfig = field(default_factory=lambda: TrainConfig(epochs=120))
    pads: tuple[int, ...] = (0,)  # seeds of the simulated pads
    seeds: int = 1
    split: str = "auto"  # what is held out of a recording: object, session, block or time
    registered: Registration | None = None  # what touches of known objects correct before anything is learnt
    softness: float = 1.0  # of the skin, in units of the nominal one's
    paper: PaperOptions = field(default_factory=PaperOptions)  # of the paper's network
    hidden_tilt: float = 0.4 * math.pi / 180  # rad, that a noisy view leaves open
    block: float = 6e-3  # m, edge of a spatial block where presses on one object are split


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
        methods=tuple(name for name in METHODS if name not in (*WITH_FORCE, "paper-mask", "pressure-network")),
        training=TrainConfig(epochs=12, batch_size=16),
    ),
    "study": TrainExperiment(
        # 99 touches of one object are too few to choose a method by. Recognition validates on these four objects too.
        simulation=Simulation(judging=("pentagon", "octagon", "marker", "pliers")),
        methods=tuple(METHODS),
        pads=tuple(range(6)),
        # All epochs, as the networks had that played the paper's episodes (docs/recognition.md).
        training=TrainConfig(epochs=120, patience=120),
    ),
}
