"""The options of `python -m tests.second_world`, without JAX."""

from dataclasses import dataclass
from pathlib import Path

from experiments.common.options import RunOptions
from i2t.cli.options import Count


@dataclass(frozen=True)
class SecondWorldArgs(RunOptions):
    """Compare predicted contact pressure with baselines under physics that i2t does not model."""

    out: Path = Path("runs/second_world")  # folder of the results, metrics.json and config.json
    skins: Count = 5  # number of random skins
    touches: Count = 20  # number of touches of each object
