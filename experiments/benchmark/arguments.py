"""The options of `python -m experiments.benchmark`, without JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from i2t.cli.options import Limits
from i2t.errors import require_extra

BenchmarkSection = Literal["training", "rendering", "skin", "latency", "simulation", "accelerator", "startup"]
PEERS: dict[BenchmarkSection, tuple[str, ...]] = {  # packages that a section compares with
    "training": ("torch",), "rendering": ("open3d", "embreex"), "skin": ("ContactMechanics",),
}  # fmt: skip


@dataclass(frozen=True)
class BenchmarkArgs:
    """Sections to run, repetitions, and the folder of `benchmark.json`."""

    sections: tuple[BenchmarkSection, ...] = ("training", "rendering", "skin")  # which
    out: Path | None = None  # folder; by default nothing is written
    turns: Annotated[int, Limits(1)] = 5  # how often each is timed
    commands: tuple[str, ...] = ()  # of section startup: those whose line contains one of these; by default all
    preset: Literal["paper", "debug"] = "paper"  # sizes: as the documents say, or very small ones

    def check(self) -> None:
        """Refuse sections whose peer is not installed."""
        for name in self.sections:
            for peer in PEERS.get(name, ()):
                require_extra(peer, f"section {name}")
