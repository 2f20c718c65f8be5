"""The options of `python -m tests.second_world`, without JAX."""

from dataclasses import dataclass
from pathlib import Path

from experiments.common.options import RunOptions
from i2t.cli.options import Count


@dataclass(frozen=True)
class SecondWorldArgs(RunOptions):
    """Does predicted contact pressure lead where the physics is another?"""

    out: Path = Path("runs/second_world")  # folder for metrics.json
    skins: Count = 5  # random skins
    touches: Count = 20  # of each object
