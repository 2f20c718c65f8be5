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

from i2t.cli import exit_code_of
from i2t.errors import DeviceError
from i2t.hardware.protocols import Samples, SkinCounters
from i2t.hardware.reskin.driver import Replay, ReSkin
from i2t.hardware.reskin.stream import BoardInfo, Stream
from i2t.skin.boards import make_board

FRAME_RATE_HZ = 10  # of pictures
LINE_RATE_HZ = 1  # of lines where the output is no terminal
SHOWN_SAMPLES = 20  # that a drawn value is the mean of
REST_SAMPLES = 100  # that the rest is the mean of
HALF_BAR_WIDTH = 16  # characters
RECONNECT_S = 1.0  # between attempts to connect


@dataclass(frozen=True)
class Options:
    """Show a ReSkin or AnySkin live: readings less those at the start, rate and losses. Ctrl-C ends it."""

    port: str | None = None
    """Serial port; by default the one board that is plugged in."""
    baud: int | None = None
    """Baud rate; by default the usual ones are tried."""
    replay: Path | None = None
    """Show this recording instead of a board."""
    board: str = "reskin"
    """Which board it is: reskin, anyskin, or grid-RxC for R rows and C columns of chips."""
    record: Path | None = None
    """Write every byte to this new file."""
    seconds: float = float("inf")
    """End after this long."""
    scale: float = 100.0
    """Microtesla at the end of a bar."""
    list_ports: Annotated[bool, tyro.conf.arg(name="list")] = False
    """List the USB serial ports and end."""


def main(args: Sequence[str] | None = None) -> int:
    """Run the monitor.

    Args:
        args: Of the command line; by default those of this process.

    Returns:
        The exit code.
    """
    asked = tyro.cli(Options, args=args, prog="python -m i2t.hardware.reskin", config=(tyro.conf.FlagCreatePairsOff,))

    def show() -> None:
        if asked.list_ports:
            boards = ReSkin().ports()
            print("\n".join(f"{board.port}  {board.usb}  {board.description}" for board in boards) or "none")
            return
        with contextlib.suppress(KeyboardInterrupt):  # which is how it ends
            chips = len(make_board(asked.board).chips)
            skin = Replay(asked.replay, chips=chips) if asked.replay else ReSkin(asked.port, asked.baud, chips=chips)
            _show_live(skin, asked)

    return exit_code_of(show)


def picture(
    info: BoardInfo, source: str, counters: SkinCounters, shown: Samples, rest: np.ndarray, *, scale: float
) -> list[str]:
    """The lines of one picture.

    Args:
        info: The board.
        source: Real, emulated or replay.
        counters: Of the skin.
        shown: Samples whose mean is drawn.
        rest: (c,) uT, subtracted from them.
        scale: uT at the end of a bar.

    Returns:
        Three lines for each chip between a head and a sum.
    """
    mean, noise = shown.reading.mean(axis=0) - rest, shown.reading.std(axis=0)
    named = " ".join(str(part) for part in (info.description, info.usb, info.serial_number) if part)
    lines = [
        f"{info.port}  {source}  {info.form}  {f'{info.baud} baud' if info.baud else ''}  {named}".rstrip(),
        f"{counters.rate:6.1f} Hz  {counters.samples} samples  lost {counters.lost} ({100 * counters.loss:.2f} %)"
        f" in {counters.gaps} gaps  {counters.skipped} stray bytes  overflowed {counters.overflowed}"
        f"  late {counters.stalls}  connected {counters.connects}x",
        "",
        f"chip         uT  noise  {f'-{scale:g}':<{HALF_BAR_WIDTH}}0{f'+{scale:g}':>{HALF_BAR_WIDTH}}",
    ]
    for chip in range(shown.temperature.shape[1]):
        for axis in range(3):
            i = 3 * chip + axis
            celsius = f"  {shown.temperature[-1, chip]:.1f} C" if axis == 0 else ""
            lines.append(f"{chip} {'xyz'[axis]}  {mean[i]:+9.1f}  {noise[i]:5.1f}  {bar(mean[i] / scale)}{celsius}")
    lines.append(f"change of all {len(mean)}: {np.linalg.norm(mean):.1f} uT")
    return lines


def bar(part: float) -> str:
    """A bar from the middle.

    Args:
        part: Its length, -1 to 1; what goes further ends in an arrow.

    Returns:
        Characters of one width for every length.
    """
    cells = round(min(1.0, abs(part)) * HALF_BAR_WIDTH)
    side = "#" * cells
    if abs(part) > 1:
        side = side[:-1] + (">" if part > 0 else "<")
    left, right = ("", side) if part >= 0 else (side[::-1] if abs(part) <= 1 else "<" + side[:-1], "")
    return f"{left:>{HALF_BAR_WIDTH}}|{right:<{HALF_BAR_WIDTH}}"


def _show_live(skin: Stream, asked: Options) -> None:
    live, end = sys.stdout.isatty(), time.monotonic() + asked.seconds
    try:
        skin.connect()
        if asked.record:
            skin.record(asked.record)
        rest, trouble = np.zeros(len(skin.features.channels)), ""
        early: list[np.ndarray] = []
        drawn = 0
        while time.monotonic() < end:
            try:
                newest = int(skin.latest().number[-1])
                shown = skin.since(newest - SHOWN_SAMPLES)
                if len(early) < REST_SAMPLES:
                    early.extend(shown.reading)
                    rest = np.mean(early, axis=0)
                trouble = ""
            except DeviceError as error:
                if asked.replay or asked.record:  # a recording must not be taken up again in silence
                    raise
                trouble = _try_again(skin, error)
            lines = [*picture(skin.info, skin.features.source, skin.counters, shown, rest, scale=asked.scale), trouble]
            if live:
                print(f"\x1b[{drawn}F\x1b[J" if drawn else "", "\n".join(lines), sep="")
                drawn = len(lines)
                time.sleep(1 / FRAME_RATE_HZ)
            else:
                print(lines[1], lines[-2], trouble, sep="  ", flush=True)
                time.sleep(1 / LINE_RATE_HZ)
    finally:
        skin.close()


def _try_again(skin: Stream, error: DeviceError) -> str:
    """Connect again after a while; returns what to say meanwhile."""
    time.sleep(RECONNECT_S)
    try:
        skin.connect()
    except DeviceError:
        return str(error)
    return ""
