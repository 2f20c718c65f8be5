"""The live picture of `python -m i2t.hardware.reskin`: every chip's field, noise and temperature, rate and losses."""

import contextlib
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from i2t.cli import exit_code_of
from i2t.errors import DeviceError
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.protocols import Samples, SkinCounters
from i2t.hardware.reskin.driver import Replay, ReSkin
from i2t.hardware.reskin.stream import BoardInfo, Stream
from i2t.skin.ambient import load_ambient, mean_known, predict_ambient, subtract_offsets
from i2t.skin.boards import make_board
from i2t.types import Board

FRAME_RATE_HZ = 10  # of pictures
LINE_RATE_HZ = 1  # of lines where the output is no terminal
SHOWN_SAMPLES = 20  # that a drawn value is the mean of
REST_SAMPLES = 100  # that the rest is the mean of
HALF_BAR_WIDTH = 16  # characters
POSE_S = 1.0  # between two questions after an arm's pose
RECONNECT_S = 1.0  # between attempts to connect


@dataclass(frozen=True)
class Options:
    """Show a ReSkin, AnySkin or eFlesh board live: readings less those at the start, or less a fitted ambient field,
    rate and losses. Ctrl-C ends it.
    """

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
    ambient: Path | None = None
    """Subtract this ambient field in place of the readings at the start (.ambient.npz in a folder of i2t.collect)."""
    host: str | None = None
    """Address of the UR controller whose arm carries the skin: its pose turns the ambient field."""
    turn: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="RX RY RZ")] = None
    """In place of --host, how the tool stands in the base for good: a rotation vector, rad."""
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
        if asked.ambient is None and (asked.host or asked.turn):
            raise ValueError("--host and --turn say how an ambient field lies in the skin; pass --ambient FILE too")
        if asked.host and asked.turn:
            raise ValueError("--host and --turn both say how the tool stands; pass one of them")
        if asked.list_ports:
            boards = ReSkin().ports()
            print("\n".join(f"{board.port}  {board.usb}  {board.description}" for board in boards) or "none")
            return
        with contextlib.suppress(KeyboardInterrupt):  # which is how it ends
            chips = make_board(asked.board).num_chips
            rest = _rest(asked)
            skin = Replay(asked.replay, chips=chips) if asked.replay else ReSkin(asked.port, asked.baud, chips=chips)
            _show_live(skin, asked, rest)

    return exit_code_of(show)


def picture(
    info: BoardInfo, source: str, counters: SkinCounters, shown: Samples, rest: np.ndarray, *, scale: float
) -> list[str]:
    """The lines of one picture.

    Args:
        info: The board.
        source: Real, emulated or replay.
        counters: Of the skin.
        shown: Samples whose mean is drawn; NaN for a chip that is missing.
        rest: (c,) uT, subtracted from them.
        scale: uT at the end of a bar.

    Returns:
        Three lines for each chip between a head and a sum.
    """
    mean = mean_known(shown.reading, axis=0) - rest
    noise = np.sqrt(mean_known((shown.reading - mean_known(shown.reading, axis=0)) ** 2, axis=0))
    warmth = mean_known(shown.temperature[-1:], axis=0)
    named = " ".join(str(part) for part in (info.description, info.usb, info.serial_number) if part)
    lines = [
        f"{info.port}  {source}  {info.form}  {f'{info.baud} baud' if info.baud else ''}  {named}".rstrip(),
        f"{counters.rate:6.1f} Hz  {counters.samples} samples  lost {counters.lost} ({100 * counters.loss:.2f} %)"
        f" in {counters.gaps} gaps  {counters.skipped} stray bytes  overflowed {counters.overflowed}"
        f"  late {counters.stalls}  connected {counters.connects}x{_chips_lost(counters)}",
        "",
        f"chip         uT  noise  {f'-{scale:g}':<{HALF_BAR_WIDTH}}0{f'+{scale:g}':>{HALF_BAR_WIDTH}}",
    ]
    for chip in range(shown.temperature.shape[1]):
        for axis in range(3):
            i = 3 * chip + axis
            celsius = f"  {warmth[chip]:.1f} C" if axis == 0 and np.isfinite(warmth[chip]) else ""
            if np.isfinite(mean[i]):
                value = f"{mean[i]:+9.1f}  {noise[i]:5.1f}  {bar(mean[i] / scale)}"
            else:
                value = f"{'missing':>9}  {'':5}  {bar(0.0)}"
            lines.append(f"{chip} {'xyz'[axis]}  {value}{celsius}")
    known = mean[np.isfinite(mean)]
    lines.append(f"change of all {len(known)}: {np.linalg.norm(known):.1f} uT")
    return lines


def _chips_lost(counters: SkinCounters) -> str:
    """What chips did that did not answer or went over their converter's end, where any did."""
    said = {"missing chips": counters.missing, "empty frames": counters.empty, "wraps": counters.wraps}
    return "".join(f"  {what} {count}" for what, count in said.items() if count)


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


class _EarlyRest:
    """The mean of the first samples, which is subtracted from all others."""

    def __init__(self) -> None:
        self._early: list[np.ndarray] = []

    def __call__(self, samples: Samples) -> tuple[np.ndarray, str]:
        """(c,) uT to subtract from samples, and what there is to say of it."""
        if len(self._early) < REST_SAMPLES:
            self._early.extend(samples.reading)
            self._mean = mean_known(np.array(self._early), axis=0)
        return self._mean, ""


class _AmbientRest:
    """A fitted ambient field, at the pose of the tool; where none is known, offsets and what all chips share."""

    def __init__(self, path: Path, board: Board, pose: Callable[[], tuple[np.ndarray, str]] | None) -> None:
        self._field, self._board, self._pose = load_ambient(path, board)[0], board, pose

    def __call__(self, samples: Samples) -> tuple[np.ndarray, str]:
        """(c,) uT to subtract from samples, and what there is to say of it."""
        reading, fitted = mean_known(samples.reading, axis=0), float(np.linalg.norm(self._field.earth))
        changed, shared = subtract_offsets(self._field, self._board, reading)
        said = f"  all chips share {np.linalg.norm(shared):.1f} uT, the fitted field has {fitted:.1f}"
        if self._pose is None:
            return reading - changed, said
        T_b_t, trouble = self._pose()
        return predict_ambient(self._field, self._board, T_b_t)[0], said + trouble


class _ToolPose:
    """How the tool of a UR arm stands, asked for now and then."""

    def __init__(self, host: str) -> None:
        from i2t.hardware.hand_eye import tool_pose

        self._ask, self._asked = partial(tool_pose, host), time.monotonic()
        self._pose = np.asarray(self._ask())

    def __call__(self) -> tuple[np.ndarray, str]:
        """T_b_t (4, 4), and what is wrong with it."""
        age = time.monotonic() - self._asked
        if age > POSE_S:
            try:
                self._pose, self._asked, age = np.asarray(self._ask()), time.monotonic(), 0.0
            except DeviceError as error:
                return self._pose, f"  the arm's pose is {age:.0f} s old ({error})"
        return self._pose, ""


def _rest(asked: Options) -> Callable[[Samples], tuple[np.ndarray, str]]:
    """What is subtracted from samples."""
    if asked.ambient is None:
        return _EarlyRest()
    board = make_board(asked.board)
    if asked.turn is not None:
        standing = pose_from_vector([0.0, 0.0, 0.0, *asked.turn])
        return _AmbientRest(asked.ambient, board, lambda: (standing, ""))
    return _AmbientRest(asked.ambient, board, _ToolPose(asked.host) if asked.host else None)


def _show_live(skin: Stream, asked: Options, subtract: Callable[[Samples], tuple[np.ndarray, str]]) -> None:
    live, end = sys.stdout.isatty(), time.monotonic() + asked.seconds
    try:
        skin.connect()
        if asked.record:
            skin.record(asked.record)
        trouble = ""
        drawn = 0
        while time.monotonic() < end:
            try:
                newest = int(skin.latest().number[-1])
                shown = skin.since(newest - SHOWN_SAMPLES)
                rest, said = subtract(shown)
                trouble = ""
            except DeviceError as error:
                if asked.replay or asked.record:  # a recording must not be taken up again in silence
                    raise
                trouble = _try_again(skin, error)
            lines = picture(skin.info, skin.features.source, skin.counters, shown, rest, scale=asked.scale)
            lines = [*lines[:-1], lines[-1] + said, trouble]
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
