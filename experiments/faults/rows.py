"""Rows of a section of the report, and the counts of its trials."""

from dataclasses import astuple, dataclass
from typing import NamedTuple


class FaultRow(NamedTuple):
    """One figure."""

    section: str
    what: str
    tried: str  # how often, of what
    measured: str
    goal: str
    met: bool | None  # None where there is no goal


@dataclass(frozen=True)
class FaultCounts:
    """Numbers of trials of each fault; the defaults are those of the report."""

    stream: float = 600.0  # s
    frames: int = 20_000
    silences: int = 20
    arm: int = 10
    presses: int = 500
    air: int = 1000
    kills: int = 200
    disk: int = 5
    touches: int = 1000
    rooms: int = 20
    mistakes: int = 1000  # of all that are listed
    sites: int = 500
    links: int = 200
    stalls: int = 100

    def times(self, share: float) -> "FaultCounts":
        """Scale all counts by a share, each at least to one."""
        return FaultCounts(*(type(count)(max(1, share * count)) for count in astuple(self)))


def worst(seconds: list[float]) -> str:
    """Median and worst of some times."""
    ordered = sorted(seconds)
    return f"median {1e3 * ordered[len(ordered) // 2]:.0f} ms, worst {1e3 * ordered[-1]:.0f} ms"
