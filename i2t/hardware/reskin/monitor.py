"""The text tool `i2t skin`: ports, each chip's change, rate, losses and health, and a table.

`--record TABLE.csv` keeps every sample:

    time_s        time since the first sample
    b0x_uT ...    three columns for each chip, in the board's order and the chips' own axes, nothing subtracted
    t0_C ...      temperatures; both are empty for a missing chip
"""

import contextlib
import csv
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from i2t.cli.exit_codes import command
from i2t.cli.options import Count, Positive
from i2t.cli.signals import ended_by_ctrl_c
from i2t.errors import DeviceError
from i2t.files.writing import end_with_whole_line
from i2t.hardware.protocols import Samples, Skin, SkinCounters
from i2t.hardware.reskin.driver import ReSkin
from i2t.hardware.skin_health import check_skin
from i2t.skin.boards import DEFAULT_BOARD, board_note, make_board, mean_finite

# number of samples that are averaged for the shown reading and for the reading at rest
SHOWN_SAMPLES, REST_SAMPLES = 20, 100


@dataclass(frozen=True)
class Options:
    """Show a ReSkin, AnySkin or eFlesh board live: change of the readings, rate, losses and health. Ctrl-C ends it."""

    port: str | None = None
    """Serial port; by default, that of the only board that is plugged in."""
    baud: Count | None = None
    """Baud rate; by default, the usual rates are tried."""
    board: str = DEFAULT_BOARD
    """Type of the board: reskin, anyskin, eflesh, grid-RxC for R rows and C columns of chips, or a file (.toml)."""
    record: Path | None = None
    """Write every sample to this new table (.csv)."""
    seconds: Positive = float("inf")
    """Duration (s); by default, until Ctrl-C."""
    list: bool = False
    """List the USB serial ports and exit."""


def table(counters: SkinCounters, shown: Samples, rest: np.ndarray) -> list[str]:
    """Format the live display of a board: stream, and change of field and temperature of each chip.

    Args:
        counters: Counts of samples and losses of the skin.
        shown: Samples whose mean is shown; NaN for a missing chip.
        rest: (c,) reading at rest in uT, which is subtracted.

    Returns:
        A line about the stream, a heading, a line for each chip, and a line about all chips.
    """
    change = (mean_finite(shown.reading, axis=0) - rest).reshape(-1, 3)
    chips = [
        f"{i:4d}  {'missing':>29}"
        if np.isnan(chip).all()
        else f"{i:4d}  {chip[0]:+9.1f} {chip[1]:+9.1f} {chip[2]:+9.1f}"
        for i, chip in enumerate(change)
    ]
    temperatures = [f"  {celsius:7.1f}" if np.isfinite(celsius) else "" for celsius in shown.temperature[-1]]
    return [
        f"{counters.rate:6.1f} Hz  {counters.samples} samples  lost {counters.lost} ({100 * counters.loss:.2f} %)"
        f" in {counters.gaps} gaps  {counters.skipped} stray bytes  {counters.empty} empty frames",
        "chip       x uT      y uT      z uT        C",
        *map("".join, zip(chips, temperatures, strict=True)),
        f"change of all: {np.linalg.norm(change[np.isfinite(change)]):.1f} uT",
    ]


def _run(args: Options) -> None:
    if args.list:
        boards = ReSkin().ports()
        print("\n".join(f"{board.port}  {board.usb}  {board.description}" for board in boards) or "none")
        return
    note, chips = board_note(args.board), make_board(args.board).num_chips
    if note:
        print(note, flush=True)
    with contextlib.ExitStack() as stack:
        stack.enter_context(ended_by_ctrl_c())
        skin = stack.enter_context(ReSkin(args.port, args.baud, chips=chips))
        info = skin.info
        print(f"{info.port}  {skin.features.source}  {info.form}  {info.baud} baud  {info.description}".rstrip())
        record = None
        if args.record is not None:
            record = stack.enter_context(record_samples(skin, args.record))
        _show(skin, args.seconds, record)


def _show(skin: ReSkin, seconds: float, record: Callable[[], int] | None) -> None:
    """Show and record samples until the time is over; raise DeviceError if the board is gone."""
    live, end, drawn = sys.stdout.isatty(), time.monotonic() + seconds, 0
    first, health, rest = int(skin.latest().number[-1]), "the first samples define zero", None
    while time.monotonic() < end:
        newest = int(skin.latest().number[-1])
        shown = skin.since(newest - SHOWN_SAMPLES)
        if record is not None:
            record()
        if rest is None and newest - first >= REST_SAMPLES:
            rest, health = judge_rest(skin.since(first))
        lines = [*table(skin.counters, shown, mean_finite(shown.reading, axis=0) if rest is None else rest), health]
        if live:
            print(f"\x1b[{drawn}F\x1b[J" if drawn else "", "\n".join(lines), sep="")
            drawn = len(lines)
        else:
            print(lines[0], lines[-2], health, sep="  ", flush=True)
        time.sleep(0.1 if live else 1.0)


def judge_rest(samples: Samples) -> tuple[Float[np.ndarray, " c"], str]:
    """Average the samples of a skin that touches nothing, and judge its health.

    Args:
        samples: n samples, at least one.

    Returns:
        `(c,)` reading at rest (uT), NaN for a missing chip, and a phrase about the skin's health.
    """
    health = check_skin(samples)
    sentences = [f"UNHEALTHY: {defect.sentence}" for defect in health.defects] or ["healthy at rest"]
    if health.missing:
        sentences.append(f"no answer from chip {', '.join(map(str, health.missing))}")
    return mean_finite(samples.reading, axis=0), "; ".join(sentences)


@contextlib.contextmanager
def record_samples(skin: Skin, path: Path) -> Iterator[Callable[[], int]]:
    """Write every sample of a skin into a new table (`--record`) while the block runs, from the newest one on.

    The last samples are written at the end of the block, also of a skin that is gone. If the disk is full, the table
    ends with a whole line.

    Args:
        skin: A connected skin.
        path: Path of the table.

    Yields:
        A function that writes the samples since its last call, and returns the number of all that it wrote. It must be
        called at least every five seconds, before the skin's queue overflows.

    Raises:
        OSError: The table exists, or cannot be written.
        DeviceError: The skin sends nothing.
    """
    first = skin.latest()
    newest, written, chips = int(first.number[-1]) - 1, 0, range(first.temperature.shape[1])
    table = path.open("x", newline="", buffering=1)
    try:
        with table as file:
            writer = csv.writer(file)

            def record() -> int:
                nonlocal newest, written
                with contextlib.suppress(DeviceError):  # `latest` reports a board that is gone
                    new = skin.since(newest)
                    columns = np.column_stack([new.time - first.time[0], new.reading, new.temperature])
                    # Six decimals exceed the resolution of the converter.
                    for number, row in zip(new.number.tolist(), columns, strict=True):
                        writer.writerow([f"{x:.6f}" if np.isfinite(x) else "" for x in row])
                        newest, written = number, written + 1
                return written

            head = ["time_s", *(f"b{i}{axis}_uT" for i in chips for axis in "xyz"), *(f"t{i}_C" for i in chips)]
            writer.writerow(head)
            try:
                yield record
            finally:
                record()
    except OSError:
        end_with_whole_line(path)
        raise


main = command(Options, _run, program="python -m i2t.hardware.reskin")
