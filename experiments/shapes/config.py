"""Presets of the stamp experiment."""

from dataclasses import dataclass, field

from experiments.shapes.methods import Methods
from experiments.shapes.world import StampPressConfig
from i2t.paper.classifier import Classifier
from i2t.skin.elasticity import Grid


@dataclass(frozen=True)
class ShapeExperiment:
    """Settings of `python -m experiments.shapes`."""

    pads: tuple[int, ...] = (0, 1, 2)  # numbers of the simulated skins
    presses: int = 1280  # on each, the paper's
    pressing: StampPressConfig = field(default_factory=StampPressConfig)
    methods: Methods = field(default_factory=Methods)
    presses_per_shape: tuple[int, ...] = (5, 20)  # that are known of a new skin
    draws: int = 5  # of those presses
    noise: tuple[float, ...] = (0.5, 2.0, 4.0)  # times the real sensor's, which the splits have; none: no other sensors
    rows: int = 8  # of each press, for what a split may hide
    more: int = 4  # times as many presses, for what limits the classifier; 0: not asked


_COARSE = Grid(20, 32)
PRESETS: dict[str, ShapeExperiment] = {
    "paper": ShapeExperiment(),
    "debug": ShapeExperiment(
        pads=(0, 1),
        presses=50,
        pressing=StampPressConfig(grid=_COARSE, friction=False, touches_per_session=25),
        methods=Methods(Classifier((16, 10), 40), Classifier((16, 10), 40), library=8, layers=1, grid=_COARSE),
        presses_per_shape=(2,),
        draws=1,
        noise=(),
        more=0,
    ),
}
