"""The text tool of `python -m i2t.hardware.reskin`: ports, every chip's change, rate, losses and health; recordings.

A recording keeps every byte as it came; `--replay RECORDING --record TABLE.csv` makes a table of it:

    time_s        from the first byte
    b0x_uT ...    three columns for each chip, in the board's order and the chips' own axes, nothing subtracted
    t0_C ...      temperatures; both are empty for a chip that is missing
"""

import contextlib
import csv
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from i2t.cli import Count, Positive, check_options, exit_code_of, read_options, require_path
from i2t.errors import DataError, DeviceError
from i2t.files import replacing
from i2t.hardware.protocols import Samples, SkinCounters
from i2t.hardware.reskin import frames, recording
from i2t.hardware.reskin.driver import BoardInfo, Replay, ReSkin, Stream, diagnose
from i2t.hardware.skin_health import check_skin
from i2t.skin.ambient import mean_known
from i2t.skin.boards import DEFAULT_BOARD, board_note, make_board

FRAME_RATE_HZ, LINE_RATE_HZ = 10, 1  # of pictures on a terminal; of lines elsewhere
SHOWN_SAMPLES, REST_SAMPLES = 20, 100  # that a drawn value, and the rest, is the mean of
HEALTHY_TEXT = "healthy at rest"
HALF_BAR_WIDTH = 16  # characters
TABLE_ENDING = ".csv"
TABLE_DECIMALS = 6  # of times and values in a table: more than the converter has
HEARD_BYTES = 4000  # of bytes that are no frames, to say why


@dataclass(frozen=True)
class Options:
    """Show a ReSkin, AnySkin or eFlesh board live: readings less those at the start, rate, losses and health. Ctrl-C
    ends it.
    """

    port: str | None = None
    """Serial port; by default the one board that is plugged in."""
    baud: Count | None = None
    """Baud rate; by default the usual ones are tried."""
    replay: Path | None = None
    """Show this recording instead of a board."""
    board: str = DEFAULT_BOARD
    """Which board it is: reskin, anyskin, eflesh, grid-RxC for R rows and C columns of chips, or a file (.toml)."""
    record: Path | None = None
    """Write every byte to this new file, which can be replayed; with --replay and a name that ends in .csv, a table of
    the recording's samples."""
    seconds: Positive = float("inf")
    """End after this long."""
    scale: Positive = 100.0
    """Microtesla at the end of a bar."""
    list: bool = False
    """List the USB serial ports and end."""


def main(args: Sequence[str] | None = None) -> int:
    """Run the tool.

    Args:
        args: Of the command line; by default those of this process.

    Returns:
        The exit code.
    """
    asked = read_options(Options, args, program="python -m i2t.hardware.reskin")
    return exit_code_of(lambda: _run(asked))


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
        Two lines on the board and its stream, three lines for each chip, and one on all of them.
    """
    mean = mean_known(shown.reading, axis=0) - rest
    noise = np.sqrt(mean_known((shown.reading - mean_known(shown.reading, axis=0)) ** 2, axis=0))
    named = " ".join(str(part) for part in (info.description, info.usb, info.serial_number) if part)
    lines = [
        f"{info.port}  {source}  {info.form}  {f'{info.baud} baud' if info.baud else ''}  {named}".rstrip(),
        f"{counters.rate:6.1f} Hz  {counters.samples} samples  lost {counters.lost} ({100 * counters.loss:.2f} %)"
        f" in {counters.gaps} gaps  {counters.skipped} stray bytes  {counters.empty} empty frames  overflowed"
        f" {counters.overflowed}  late {counters.stalls}  connected {counters.connects}x",
        "",
        f"chip         uT  noise  {f'-{scale:g}':<{HALF_BAR_WIDTH}}0{f'+{scale:g}':>{HALF_BAR_WIDTH}}",
    ]
    for i, (value, sigma) in enumerate(zip(mean, noise, strict=True)):
        known, celsius = np.isfinite(value), shown.temperature[-1, i // 3]
        said = f"{value:+9.1f}  {sigma:5.1f}  {bar(value / scale)}" if known else f"{'missing':>9}"
        warmth = f"  {celsius:.1f} C" if i % 3 == 0 and np.isfinite(celsius) else ""
        lines.append(f"{i // 3} {'xyz'[i % 3]}  {said}{warmth}")
    known_means = mean[np.isfinite(mean)]
    return [*lines, f"change of all {len(known_means)}: {np.linalg.norm(known_means):.1f} uT"]


def bar(part: float) -> str:
    """A bar from the middle.

    Args:
        part: Its length, -1 to 1; what goes further ends in an arrow.

    Returns:
        Characters of one width for every length.
    """
    side = "#" * round(min(1.0, abs(part)) * HALF_BAR_WIDTH)
    if abs(part) > 1:
        side = side[:-1] + ">"
    left, right = ("", side) if part >= 0 else (side[::-1].replace(">", "<"), "")
    return f"{left:>{HALF_BAR_WIDTH}}|{right:<{HALF_BAR_WIDTH}}"


def samples_of(path: str | Path, chips: int) -> Samples:
    """Samples of a recording of bytes.

    Args:
        path: Of the recording.
        chips: How many magnetometers the board has.

    Returns:
        All samples; times in s from the first byte.

    Raises:
        DeviceError: It holds no frames of such a board.
        DataError: It cannot be a recording.
        OSError: It cannot be read.
    """
    decoders, found, heard = frames.decoders(chips), list[tuple[float, frames.Frame]](), b""
    for when, chunk in recording.chunks(path):
        heard = (heard + chunk)[-HEARD_BYTES:]
        decoders, more = frames.decode_any(decoders, chunk)
        found += [(when, frame) for frame in more]
    if not found:
        raise DeviceError(f"no skin in {path}: {diagnose(heard, chips)}")
    times, (_, readings, temperatures) = [when for when, _ in found], zip(*(frame for _, frame in found), strict=True)
    return Samples(np.arange(len(found)), *(np.array(each) for each in (times, readings, temperatures)))


def write_table(path: Path, samples: Samples) -> Path:
    """Write samples as a table, whole or not at all.

    Args:
        path: Of the new file, .csv.
        samples: Of one board.

    Returns:
        The file.

    Raises:
        DataError: There is such a file already, or it cannot be written.
    """
    if path.exists():
        raise DataError(f"{path}: exists already; give the table a new name")
    chips = range(samples.temperature.shape[1])
    columns = np.column_stack([samples.time, samples.reading, samples.temperature])
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time_s", *(f"b{i}{axis}_uT" for i in chips for axis in "xyz"), *(f"t{i}_C" for i in chips)])
        rows.writerows([f"{x:.{TABLE_DECIMALS}f}" if np.isfinite(x) else "" for x in row] for row in columns)
    return path


def _run(asked: Options) -> None:
    check_options(asked)
    require_path("--replay", asked.replay, "recording")
    if asked.list:
        boards = ReSkin().ports()
        print("\n".join(f"{board.port}  {board.usb}  {board.description}" for board in boards) or "none")
        return
    if asked.replay and asked.port:
        raise ValueError("--replay and --port both say what to show; pass one of them")
    note, chips = board_note(asked.board), make_board(asked.board).num_chips
    if note:
        print(note, flush=True)
    if asked.record and asked.record.suffix.lower() == TABLE_ENDING:
        if asked.replay is None:
            raise ValueError(f"--record {asked.record}: record bytes, and then make the table with --replay")
        samples = samples_of(asked.replay, chips)
        print(f"wrote {len(samples.number)} samples to {write_table(asked.record, samples)}")
        return
    skin = Replay(asked.replay, chips=chips) if asked.replay else ReSkin(asked.port, asked.baud, chips=chips)
    with contextlib.suppress(KeyboardInterrupt), skin:  # Ctrl-C is how it ends
        if asked.record:
            skin.record(asked.record)
        _show(skin, asked)


def _show(skin: Stream, asked: Options) -> None:
    """Draw until the time is over; a board that is gone is an error."""
    live, end, drawn = sys.stdout.isatty(), time.monotonic() + asked.seconds, 0
    first, health, rest = int(skin.latest().number[-1]), "the first samples are its zero", None
    while time.monotonic() < end:
        newest = int(skin.latest().number[-1])
        shown = skin.since(newest - SHOWN_SAMPLES)
        if rest is None and newest - first >= REST_SAMPLES:
            early = skin.since(first)
            rest, found = mean_known(early.reading, axis=0), check_skin(early).defects
            health = "; ".join(f"UNHEALTHY: {each.sentence}" for each in found) or HEALTHY_TEXT
        zero = mean_known(shown.reading, axis=0) if rest is None else rest
        lines = [*picture(skin.info, skin.features.source, skin.counters, shown, zero, scale=asked.scale), health]
        if live:
            print(f"\x1b[{drawn}F\x1b[J" if drawn else "", "\n".join(lines), sep="")
            drawn = len(lines)
        else:
            print(lines[1], lines[-2], health, sep="  ", flush=True)
        time.sleep(1 / (FRAME_RATE_HZ if live else LINE_RATE_HZ))
