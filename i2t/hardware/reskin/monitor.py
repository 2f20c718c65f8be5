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

from i2t.cli import Count, Positive, check_options, exit_code_of, require_path
from i2t.errors import DataError, DeviceError
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.protocols import Samples, SkinCounters
from i2t.hardware.reskin.driver import RATE_HZ, Replay, ReSkin
from i2t.hardware.reskin.keys import pressed_keys
from i2t.hardware.reskin.stream import BoardInfo, Stream
from i2t.hardware.reskin.tables import is_table, samples_of, write_table
from i2t.hardware.skin_health import check_skin
from i2t.options import read_options
from i2t.skin.ambient import load_ambient, mean_known, predict_ambient, subtract_offsets
from i2t.skin.boards import DEFAULT_BOARD, board_note, make_board
from i2t.types import Board

FRAME_RATE_HZ = 10  # of pictures
LINE_RATE_HZ = 1  # of lines where the output is no terminal
SHOWN_SAMPLES = 20  # that a drawn value is the mean of
REST_SAMPLES = 100  # that the rest is the mean of
HEALTHY_TEXT = "healthy at rest"
HALF_BAR_WIDTH = 16  # characters
MAP_CELL_WIDTH = 12  # characters
THIN_ARROWS, DOUBLE_ARROWS = "→↗↑↖←↙↓↘", "⇒⇗⇑⇖⇐⇙⇓⇘"  # every eighth of a turn, from x on
POSE_S = 1.0  # between two questions after an arm's pose
RECONNECT_S = 1.0  # between attempts to connect


@dataclass(frozen=True)
class Options:
    """Show ReSkin, AnySkin or eFlesh boards live: readings less those at the start, or less a fitted ambient field,
    rate and losses. Keys: z zeroes again, m shows a map of the chips, q or Ctrl-C ends it.
    """

    port: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Serial port, repeated for several boards; by default the one board that is plugged in."""
    baud: Count | None = None
    """Baud rate; by default the usual ones are tried."""
    replay: Path | None = None
    """Show this recording instead of a board."""
    board: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Which board it is: reskin (the default), anyskin, eflesh, grid-RxC for R rows and C columns of chips, or a file
    (.toml); of several boards one for all, or repeated in the order of the ports."""
    record: Path | None = None
    """Write every byte to this new file, which can be replayed; one ending in .csv or .npz is a table of samples. Of
    several boards each has a file, numbered after the first. With --replay a table is made of the recording at once."""
    map: bool = False
    """Begin with the map of the chips."""
    ambient: Path | None = None
    """Subtract this ambient field in place of the readings at the start (.ambient.npz in a folder of i2t.collect)."""
    host: str | None = None
    """Address of the UR controller whose arm carries the skin: its pose turns the ambient field."""
    turn: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="RX RY RZ")] = None
    """In place of --host, how the tool stands in the base for good: a rotation vector, rad."""
    seconds: Positive = float("inf")
    """End after this long."""
    scale: Positive = 100.0
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
    asked = read_options(Options, args, program="python -m i2t.hardware.reskin")

    def show() -> None:
        check_options(asked)
        require_path("--replay", asked.replay, "recording")
        require_path("--ambient", asked.ambient, "file")
        if asked.ambient is None and (asked.host or asked.turn):
            raise ValueError("--host and --turn say how an ambient field lies in the skin; pass --ambient FILE too")
        if asked.host and asked.turn:
            raise ValueError("--host and --turn both say how the tool stands; pass one of them")
        if asked.list_ports:
            boards = ReSkin().ports()
            print("\n".join(f"{board.port}  {board.usb}  {board.description}" for board in boards) or "none")
            return
        _check_recording(asked)
        boards_shown = _boards(asked)
        for note in filter(None, map(board_note, dict.fromkeys(boards_shown))):
            print(note, flush=True)
        if asked.replay and asked.record and is_table(asked.record):
            samples = samples_of(asked.replay, make_board(boards_shown[0]).num_chips, RATE_HZ)
            print(f"wrote {len(samples.number)} samples to {write_table(asked.record, samples)}")
            return
        with contextlib.suppress(KeyboardInterrupt):  # which is how it ends
            _show_live(_views(asked), asked)

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
    """Counts of chips that did not answer or went over their converter's end, where any did."""
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


def map_picture(board: Board, change: np.ndarray, *, scale: float) -> list[str]:
    """The chips where they lie under the skin, seen from outside, each with its change of field.

    Args:
        board: Of n chips.
        change: (3 n,) uT, in the board's order and the chips' own axes; NaN for a chip that is missing.
        scale: uT that are an arrow's full length.

    Returns:
        Lines: an arrow for the part along the skin (by its size `.`, a thin or a double one), and the part out of it.
    """
    places = np.asarray(board.chips, float)[:, :2]
    fields = np.asarray(board.to_tool(np.asarray(change, float)))
    across = np.unique(np.round(places[:, 0], 4))
    down = np.unique(np.round(places[:, 1], 4))[::-1]
    cells = {(round(x, 4), round(y, 4)): _map_cell(field, scale) for (x, y), field in zip(places, fields, strict=True)}
    lines = ["".join(cells.get((x, y), "").center(MAP_CELL_WIDTH) for x in across).rstrip() for y in down]
    return [line for pair in zip(lines, [""] * len(lines), strict=True) for line in pair][:-1]


def _map_cell(field: np.ndarray, scale: float) -> str:
    if not np.isfinite(field).all():
        return "missing"
    size = float(np.hypot(field[0], field[1]))
    arrows = THIN_ARROWS if size < scale / 2 else DOUBLE_ARROWS
    turn = round(float(np.arctan2(field[1], field[0])) / (np.pi / 4)) % 8
    return f"{'.' if size < scale / 10 else arrows[turn]} {field[2]:+.0f}"


class _EarlyRest:
    """The mean of the first samples, which is subtracted from all others."""

    def __init__(self) -> None:
        self._early: list[np.ndarray] = []

    def again(self) -> None:
        """Begin anew with the next samples."""
        self._early = []

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

    def again(self) -> None:
        """Do nothing: a fitted field needs no zero."""

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
    """Pose of the tool of a UR arm, asked for now and then."""

    def __init__(self, host: str) -> None:
        from i2t.hardware.ur.access import tool_pose

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


def _boards(asked: Options) -> tuple[str, ...]:
    """Names of the boards that are shown, in the order of their ports."""
    count = max(1, len(asked.port))
    names = asked.board or (DEFAULT_BOARD,)
    if len(names) not in (1, count):
        raise ValueError(f"--board names {len(names)} boards for {count} ports; give one for all, or one for each")
    return names * count if len(names) == 1 else names


def _rest(asked: Options, board: Board) -> "_EarlyRest | _AmbientRest":
    """Baseline that is subtracted from samples."""
    if asked.ambient is None:
        return _EarlyRest()
    if asked.turn is not None:
        standing = pose_from_vector([0.0, 0.0, 0.0, *asked.turn])
        return _AmbientRest(asked.ambient, board, lambda: (standing, ""))
    return _AmbientRest(asked.ambient, board, _ToolPose(asked.host) if asked.host else None)


@dataclass
class _View:
    """One board as it is shown."""

    skin: Stream
    board: Board
    subtract: "_EarlyRest | _AmbientRest"
    record: Path | None  # recording of bytes, or the table that is made of it in the end
    lasting: bool  # whether a board that is gone ends the program: a recording is not taken up again in silence
    began: float = 0.0  # Unix time in s
    shown: Samples | None = None
    rest: np.ndarray | None = None
    said: str = ""
    trouble: str = ""
    first: int = -1  # number of the first sample that was shown, until its health has been judged
    health: str = ""  # what is wrong with the skin as it was at the start

    @property
    def bytes_file(self) -> Path | None:
        """File for the bytes."""
        table = self.record is not None and is_table(self.record)
        return self.record.with_name(f"{self.record.name}.bytes") if self.record and table else self.record

    def start(self) -> None:
        """Connect, and begin to record."""
        self.skin.connect()
        if self.bytes_file is not None:
            self.began = time.time()
            self.skin.record(self.bytes_file)

    def look(self) -> None:
        """Take the newest samples."""
        try:
            newest = int(self.skin.latest().number[-1])
            self.shown = self.skin.since(newest - SHOWN_SAMPLES)
            self.rest, self.said = self.subtract(self.shown)
            self.trouble = ""
            self._judge(newest)
        except DeviceError as error:
            if self.lasting:
                raise
            self.trouble = _try_again(self.skin, error)

    def _judge(self, newest: int) -> None:
        """Judge the skin's health once enough samples have come; it should touch nothing then."""
        if self.health:
            return
        self.first = newest if self.first < 0 else self.first
        if newest - self.first >= REST_SAMPLES:
            found = check_skin(self.skin.since(self.first)).defects
            self.health = "; ".join(f"UNHEALTHY: {each.sentence}" for each in found) or HEALTHY_TEXT

    def picture(self, scale: float, as_map: bool) -> list[str]:
        """Lines of the board's picture; the second is the head, the last but one the sum."""
        if self.shown is None or self.rest is None:
            return ["", "", "", self.trouble]
        skin = self.skin
        lines = picture(skin.info, skin.features.source, skin.counters, self.shown, self.rest, scale=scale)
        if as_map:
            change = mean_known(self.shown.reading, axis=0) - self.rest
            lines = [*lines[:3], *map_picture(self.board, change, scale=scale), lines[-1]]
        return [*lines[:-1], lines[-1] + self.said, self.trouble or self.health]

    def finish(self) -> str:
        """Close the board, and write the table; returns a sentence about it."""
        self.skin.close()
        file = self.bytes_file
        if self.record is None or file is None or file == self.record or not file.exists():
            return ""
        try:
            samples = samples_of(file, self.board.num_chips, RATE_HZ)
            write_table(self.record, samples, self.began)
        except (DeviceError, DataError, OSError) as error:
            return f"no table was made, and the bytes are kept in {file}: {error}"
        file.unlink()
        return f"wrote {len(samples.number)} samples to {self.record}"


def _views(asked: Options) -> list[_View]:
    lasting = bool(asked.replay or asked.record)
    views: list[_View] = []
    for number, (port, name) in enumerate(zip(asked.port or (None,), _boards(asked), strict=True)):
        board = make_board(name)
        skin = (
            Replay(asked.replay, chips=board.num_chips)
            if asked.replay
            else ReSkin(port, asked.baud, chips=board.num_chips)
        )
        views.append(_View(skin, board, _rest(asked, board), _numbered(asked.record, number), lasting))
    return views


def _numbered(path: Path | None, number: int) -> Path | None:
    """The file of the board of this number."""
    return path if path is None or number == 0 else path.with_name(f"{path.stem}-{number + 1}{path.suffix}")


def _check_recording(asked: Options) -> None:
    """Refuse options that would fail only at the end."""
    if asked.replay and len(asked.port) > 0:
        raise ValueError("--replay and --port both say what to show; pass one of them")
    if len(set(asked.port)) < len(asked.port):
        raise ValueError("--port names one board twice; name each once")
    for number in range(max(1, len(asked.port))):
        file = _numbered(asked.record, number)
        if file is not None and is_table(file):
            for taken in (file, file.with_name(f"{file.name}.bytes")):
                if taken.exists():
                    raise FileExistsError(f"{taken}: exists already; give the recording a new name")


def _show_live(views: list[_View], asked: Options) -> None:
    live, end, as_map, drawn = sys.stdout.isatty(), time.monotonic() + asked.seconds, asked.map, 0
    try:
        for view in views:
            view.start()
        with pressed_keys() as keys:
            while time.monotonic() < end:
                for key in keys.newest():
                    as_map ^= key == "m"
                    end = time.monotonic() if key == "q" else end
                    for view in views if key == "z" else ():
                        view.subtract.again()
                for view in views:
                    view.look()
                pictures = [view.picture(asked.scale, as_map) for view in views]
                if live:
                    lines = [line for each in pictures for line in each]
                    print(f"\x1b[{drawn}F\x1b[J" if drawn else "", "\n".join(lines), sep="")
                    drawn = len(lines)
                    time.sleep(1 / FRAME_RATE_HZ)
                else:
                    for each in pictures:
                        print(each[1], each[-2], each[-1], sep="  ", flush=True)
                    time.sleep(1 / LINE_RATE_HZ)
    finally:
        for view in views:
            said = view.finish()
            if said:
                print(said)


def _try_again(skin: Stream, error: DeviceError) -> str:
    """Connect again after a while; returns what to say meanwhile."""
    time.sleep(RECONNECT_S)
    try:
        skin.connect()
    except DeviceError:
        return str(error)
    return ""
