"""The options of `python -m experiments.second_world`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from i2t.cli import Count, Limits, Seed

Mistake = Literal["none", "force_sign", "millimetres", "millitesla"]


@dataclass(frozen=True)
class SecondWorldArgs:
    """Train in a world of other physics."""

    out: Path = Path("runs/second-world")
    preset: Literal["paper", "debug"] = "paper"  # debug: a few touches, too few to mean anything
    sessions: Count | None = None  # of each object; 3 unless given, of debug 2
    touches: Count | None = None  # of a session; 24 unless given, of debug 6
    softness: Annotated[float, Limits(0, 1000, above=True)] = 1.0  # of the skin, for experiments.train
    mistake: Mistake = "none"  # that is made on purpose in the files
    seed: Seed = 0
    resume: bool = False  # go on with an unfinished run in --out
    overwrite: bool = False  # replace a finished or unfinished one

    @property
    def sizes(self) -> tuple[int, int]:
        """Sessions of each object, and touches of a session."""
        sessions, touches = (2, 6) if self.preset == "debug" else (3, 24)
        return self.sessions or sessions, self.touches or touches

    def check(self) -> None:
        """Refuse nothing: all options go together."""
