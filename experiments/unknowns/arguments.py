"""The options of `python -m experiments.unknowns`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from i2t.cli import Count, Limits, Seed

Question = Literal["lag", "height", "swap", "stage", "flip", "since"]
QUESTIONS: tuple[Question, ...] = get_args(Question)
UNKNOWNS_KINDS = ("bonded", "loose", "uniform", "weak", "lattice")


@dataclass(frozen=True)
class UnknownsArgs:
    """Mistakes put into simulated recordings, and which are found."""

    out: Path = Path("runs/unknowns")  # folder for everything that is made
    cases: Count = 10  # skins of each kind
    presses: Annotated[int, Limits(60)] = 160  # of each skin
    seed: Seed = 316  # of the skins and of what is put into them; figures are of 316, and nothing is chosen on it
    kinds: tuple[str, ...] = UNKNOWNS_KINDS  # of skins
    questions: tuple[Question, ...] = QUESTIONS  # that are asked of them
    overwrite: bool = False  # replace a run in --out

    @property
    def next_command(self) -> str:
        """Command to try with a finished run."""
        return "python -m experiments.fidelity --help"

    def check(self) -> None:
        """Refuse kinds of skins that are not simulated."""
        if unknown := set(self.kinds) - set(UNKNOWNS_KINDS):
            raise ValueError(
                f"--kinds {', '.join(sorted(unknown))} are not simulated; choose of {', '.join(UNKNOWNS_KINDS)}"
            )
