"""The live picture of `python -m i2t.hardware.reskin`: every chip's field, noise and temperature, rate and losses."""

import contextlib
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from i2t.cli import ended
from i2t.errors import DeviceError
from i2t.hardware.protocols import Samples, SkinCounters
from i2t.hardware.reskin.driver import Replay, ReSkin
from i2t.hardware.reskin.stream import BoardInfo, Stream
from i2t.types import CHIPS, READINGS

FRAMES_PER_SECOND = 10
SHOWN = 20  # samples that a drawn value is the mean of
RESTED = 100  # samples that the rest is the mean of
WIDTH = 16  # characters of half a bar
AGAIN = 1.0  # s between attempts to connect


@dataclass(frozen=True)
class Options:
    """Show a ReSkin or AnySkin live: readings less those at the start, rate and losses. Ctrl-C ends it."""

    port: str | None = None
    """Serial port; by default the one board that is plugged in."""
    baud: int | None = None
    """Baud rate; by default the usual ones are tried."""
    replay: Path | None = None
    """Show this recording instead of a board."""
    record: Path | None = None
    """Write every byte to this new file."""
    seconds: float = float("inf")
    """End after this long."""
    scale: float = 100.0
    """Microtesla at the end of a bar."""
    list_ports: Annotated[bool, tyro.conf.arg(name="list")] = False
    """List the USB serial ports and end."""


def main(args: Sequence[str] | None = None) -> int:
    """Run the monitor; returns the exit code."""
    asked = tyro.cli(Options, args=args, prog="python -m i2t.hardware.reskin", config=(tyro.conf.FlagCreatePairsOff,))

    def show() -> None:
        if asked.list_ports:
            boards = ReSkin().ports()
            print("\n".join(f"{board.port}  {board.usb}  {board.description}" for board in boards) or "none")
            return
        with contextlib.suppress(KeyboardInterrupt):  # which is how it ends
            _watch(Replay(asked.replay) if asked.replay else ReSkin(asked.port, asked.baud), asked)

    return ended(show)


def picture(
    info: BoardInfo, source: str, counters: SkinCounters, shown: Samples, rest: np.ndarray, scale: float
) -> list[str]:
    """The lines of one frame: means of the samples `shown` less `rest` (15,), in uT."""
    mean, noise = shown.reading.mean(axis=0) - rest, shown.reading.std(axis=0)
    named = " ".join(str(part) for part in (info.description, info.usb, info.serial_number) if part)
    lines = [
        f"{info.port}  {source}  {info.form}  {f'{info.baud} baud' if info.baud else ''}  {named}".rstrip(),
        f"{counters.rate:6.1f} Hz  {counters.samples} samples  lost {counters.lost} ({100 * counters.loss:.2f} %)"
        f" in {counters.gaps} gaps  {counters.skipped} stray bytes  overflowed {counters.overflowed}"
        f"  late {counters.stalls}  connected {counters.connects}x",
        "",
        f"chip         uT  noise  {f'-{scale:g}':<{WIDTH}}0{f'+{scale:g}':>{WIDTH}}",
    ]
    for chip in range(CHIPS):
        for axis in range(3):
            i = 3 * chip + axis
            celsius = f"  {shown.temperature[-1, chip]:.1f} C" if axis == 0 else ""
            lines.append(f"{chip} {'xyz'[axis]}  {mean[i]:+9.1f}  {noise[i]:5.1f}  {bar(mean[i] / scale)}{celsius}")
    lines.append(f"change of all 15: {np.linalg.norm(mean):.1f} uT")
    return lines


def bar(part: float) -> str:
    """A bar from the middle, -1 to 1; what goes further ends in an arrow."""
    cells = round(min(1.0, abs(part)) * WIDTH)
    side = "#" * cells
    if abs(part) > 1:
        side = side[:-1] + (">" if part > 0 else "<")
    left, right = ("", side) if part >= 0 else (side[::-1] if abs(part) <= 1 else "<" + side[:-1], "")
    return f"{left:>{WIDTH}}|{right:<{WIDTH}}"


def _watch(skin: Stream, asked: Options) -> None:
    live, end = sys.stdout.isatty(), time.monotonic() + asked.seconds
    try:
        skin.connect()
        if asked.record:
            skin.record(asked.record)
        rest, trouble = np.zeros(READINGS), ""
        early: list[np.ndarray] = []
        drawn = 0
        while time.monotonic() < end:
            try:
                newest = int(skin.latest().number[-1])
                shown = skin.since(newest - SHOWN)
                if len(early) < RESTED:
                    early.extend(shown.reading)
                    rest = np.mean(early, axis=0)
                trouble = ""
            except DeviceError as error:
                if asked.replay or asked.record:  # a recording must not be taken up again in silence
                    raise
                trouble = _try_again(skin, error)
            lines = [*picture(skin.info, skin.features.source, skin.counters, shown, rest, asked.scale), trouble]
            if live:
                print(f"\x1b[{drawn}F\x1b[J" if drawn else "", "\n".join(lines), sep="")
                drawn = len(lines)
                time.sleep(1 / FRAMES_PER_SECOND)
            else:
                print(lines[1], lines[-2], trouble, sep="  ", flush=True)
                time.sleep(1.0)
    finally:
        skin.close()


def _try_again(skin: Stream, error: DeviceError) -> str:
    """Connect again after a while; returns what to say meanwhile."""
    time.sleep(AGAIN)
    try:
        skin.connect()
    except DeviceError:
        return str(error)
    return ""
