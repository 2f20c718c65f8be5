"""Sources of a ReSkin's bytes, without its driver."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ReSkinConfig:
    """A ReSkin or AnySkin board; see `i2t.hardware.reskin.driver.ReSkin`."""

    port: str | None = None  # by default the one board that is plugged in
    board: str = "reskin"  # as `i2t.skin.boards.make_board` knows it
    serial_number: str | None = None  # of the board, in place of its port


@dataclass(frozen=True)
class ReplayConfig:
    """A recording in place of a board; see `i2t.hardware.reskin.driver.Replay`."""

    file: Path
    board: str = "reskin"  # as `i2t.skin.boards.make_board` knows it
