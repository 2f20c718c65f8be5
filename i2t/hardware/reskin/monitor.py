"""The text tool of `python -m i2t.hardware.reskin`: ports, each chip's change, rate, losses, health; a table.

`--record TABLE.csv` keeps every sample:

    time_s        from the first sample
    b0x_uT ...    three columns for each chip, in the board's order and the chips' own axes, nothing subtracted
    t0_C ...      temperatures; both are empty for a chip that is missing
"""

import contextlib
import csv
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from i2t.cli.exit_codes import command
from i2t.cli.options import Count, Positive
from i2t.errors import DeviceError
from i2t.hardware.protocols import Samples, SkinCounters
from i2t.hardware.reskin.driver import ReSkin
from i2t.hardware.skin_health import check_skin
from i2t.skin.boards import DEFAULT_BOARD, board_note, make_board, mean_known

TABLE_RATE_HZ, LINE_RATE_HZ = 10, 1  # of tables on a terminal; of lines elsewhere
SHOWN_SAMPLES, REST_SAMPLES = 20, 100  # that a shown value, and the rest, is the mean of
HEALTHY_TEXT = "healthy at rest"
DECIMALS = 6  # of times and values in a file: more than the converter has


@dataclass(frozen=True)
class Options:
    """Show a ReSkin, AnySkin or eFlesh board live: readings less those at the start, rate, losses and health. Ctrl-C
    ends it.
    """

    port: str | None = None
    """Serial port; by default the one board that is plugged in."""
    baud: Count | None = None
    """Baud rate; by default the usual ones are tried."""
    board: str = DEFAULT_BOARD
    """Which board it is: reskin, anyskin, eflesh, grid-RxC for R rows and C columns of chips, or a file (.toml)."""
    record: Path | None = None
    """Write every sample to this new table (.csv)."""
    seconds: Positive = float("inf")
    """End after this long."""
    list: bool = False
    """List the USB serial ports and end."""


def table(counters: SkinCounters, shown: Samples, rest: np.ndarray) -> list[str]:
    """The lines that are shown.

    Args:
        counters: Of the skin.
        shown: Samples whose mean is shown; NaN for a chip that is missing.
        rest: (c,) uT, subtracted from it.

    Returns:
        A line on the stream, a heading, one for each chip, and one on all of them.
    """
    change = (mean_known(shown.reading, axis=0) - rest).reshape(-1, 3)
    chips = [
        f"{i:4d}  {'missing':>29}"
        if np.isnan(each).all()
        else f"{i:4d}  {each[0]:+9.1f} {each[1]:+9.1f} {each[2]:+9.1f}"
        for i, each in enumerate(change)
    ]
    warmth = [f"  {celsius:7.1f}" if np.isfinite(celsius) else "" for celsius in shown.temperature[-1]]
    return [
        f"{counters.rate:6.1f} Hz  {counters.samples} samples  lost {counters.lost} ({100 * counters.loss:.2f} %)"
        f" in {counters.gaps} gaps  {counters.skipped} stray bytes  {counters.empty} empty frames",
        "chip       x uT      y uT      z uT        C",
        *map("".join, zip(chips, warmth, strict=True)),
        f"change of all: {np.linalg.norm(change[np.isfinite(change)]):.1f} uT",
    ]


def _run(asked: Options) -> None:
    if asked.list:
        boards = ReSkin().ports()
        print("\n".join(f"{board.port}  {board.usb}  {board.description}" for board in boards) or "none")
        return
    note, chips = board_note(asked.board), make_board(asked.board).num_chips
    if note:
        print(note, flush=True)
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.suppress(KeyboardInterrupt))  # Ctrl-C is how it ends
        skin = stack.enter_context(ReSkin(asked.port, asked.baud, chips=chips))
        info = skin.info
        print(f"{info.port}  {skin.features.source}  {info.form}  {info.baud} baud  {info.description}".rstrip())
        keep = None
        if asked.record is not None:
            file = stack.enter_context(asked.record.open("x", newline="", buffering=1))
            keep = stack.callback(_keeper(skin, csv.writer(file)))  # the rest, also of a board that is gone
        _show(skin, asked.seconds, keep)


def _show(skin: ReSkin, seconds: float, keep: Callable[[], None] | None) -> None:
    """Show and keep samples until the time is over; a board that is gone is an error."""
    live, end, drawn = sys.stdout.isatty(), time.monotonic() + seconds, 0
    first, health, rest = int(skin.latest().number[-1]), "the first samples are its zero", None
    while time.monotonic() < end:
        newest = int(skin.latest().number[-1])
        shown = skin.since(newest - SHOWN_SAMPLES)
        if keep is not None:
            keep()
        if rest is None and newest - first >= REST_SAMPLES:
            early = skin.since(first)
            rest, found = mean_known(early.reading, axis=0), check_skin(early).defects
            health = "; ".join(f"UNHEALTHY: {each.sentence}" for each in found) or HEALTHY_TEXT
        lines = [*table(skin.counters, shown, mean_known(shown.reading, axis=0) if rest is None else rest), health]
        if live:
            print(f"\x1b[{drawn}F\x1b[J" if drawn else "", "\n".join(lines), sep="")
            drawn = len(lines)
        else:
            print(lines[0], lines[-2], health, sep="  ", flush=True)
        time.sleep(1 / (TABLE_RATE_HZ if live else LINE_RATE_HZ))


def _keeper(skin: ReSkin, file: Any) -> Callable[[], None]:
    """Begin a table; what is returned writes the samples that have come since the last call, from the newest one on."""
    begun = skin.latest()
    kept, chips = int(begun.number[-1]) - 1, range(begun.temperature.shape[1])
    file.writerow(["time_s", *(f"b{i}{axis}_uT" for i in chips for axis in "xyz"), *(f"t{i}_C" for i in chips)])

    def keep() -> None:
        nonlocal kept
        with contextlib.suppress(DeviceError):  # which `latest` says, of a board that is gone
            new = skin.since(kept)
            columns = np.column_stack([new.time - begun.time[0], new.reading, new.temperature])
            file.writerows([f"{x:.{DECIMALS}f}" if np.isfinite(x) else "" for x in row] for row in columns)
            kept = max([kept, *new.number.tolist()])

    return keep


main = command(Options, _run, program="python -m i2t.hardware.reskin")
