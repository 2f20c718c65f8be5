"""Options of `python -m experiments.benchmark`, free of JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from i2t.cli.options import Limits
from i2t.errors import require_extra

BenchmarkSection = Literal["training", "rendering", "skin", "latency", "simulation", "accelerator", "startup"]
PEERS: dict[BenchmarkSection, tuple[str, ...]] = {  # packages with which a section compares i2t
    "training": ("torch",), "rendering": ("open3d", "embreex"), "skin": ("ContactMechanics",),
}  # fmt: skip


@dataclass(frozen=True)
class BenchmarkArgs:
    """Sections to run, repetitions, and the folder of `benchmark.json`."""

    sections: tuple[BenchmarkSection, ...] = ("training", "rendering", "skin")  # sections to run
    out: Path | None = None  # output folder; default: nothing is written
    turns: Annotated[int, Limits(1)] = 5  # timed turns
    commands: tuple[str, ...] = ()  # for section startup: parts of the command lines to run; default: all
    preset: Literal["paper", "debug"] = "paper"  # size of the experiment; debug runs every part once

    def check(self) -> None:
        """Refuse sections whose peer is not installed."""
        for name in self.sections:
            for peer in PEERS.get(name, ()):
                require_extra(peer, f"section {name}")
