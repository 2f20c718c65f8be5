"""Progress of long work: a bar on a terminal, otherwise a line from time to time, so that logs stay short.

The first batch of a program includes its compilation, so the remaining time is estimated from the second batch on.
`TQDM_DISABLE=1` in the environment disables both.
"""

import sys
import time
from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias

from tqdm import tqdm

FIRST_LINE_S = 5.0  # s until the first progress line where stderr is not a terminal; shorter work writes no line
LOG_INTERVAL_S = 30.0  # s between the lines after the first
Progress: TypeAlias = tqdm  # result of `progress`: an iterable, or a counter with `update`


def progress(
    items: Iterable[Any] | None = None, *, desc: str = "", unit: str = "steps", at_most: bool = False, **options: Any
) -> Progress:
    """Show progress on stderr: a bar on a terminal, otherwise a line once the remaining time is known, and then every
    half a minute.

    Args:
        items: Items to iterate over; without them, `update` counts.
        desc: Name of the work.
        unit: Unit of the count, in the plural.
        at_most: Whether the work may end before `total` is reached.
        **options: Options of tqdm, such as `total`.

    Returns:
        An iterable over the items, or a counter.
    """
    terminal = sys.stderr is not None and sys.stderr.isatty()
    return (_Bar if terminal else _Lines)(items, desc=desc, unit=unit, at_most=at_most, **options)


class _Bar(tqdm):
    """Progress as a bar, which can be closed even if Ctrl-C interrupted its construction."""

    disable: bool = True
    _first_batch: tuple[float, float] | None = None  # count and time (s) at the end of the first batch

    def __init__(self, *args: Any, at_most: bool = False, **options: Any) -> None:
        self._bound = "at most " if at_most else ""
        words = "{unit} at most" if at_most else "{unit}"
        super().__init__(*args, **options)
        if not self.disable and "bar_format" not in options:
            counted = f"{{n_fmt}}/{{total_fmt}} {words} [{{elapsed}}<{{remaining}}]"
            self.bar_format = f"{{l_bar}}{{bar}}| {counted}" if self.total else "{desc}: {n_fmt} {unit} [{elapsed}]"

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the items, each of which is a batch."""
        if self.disable:
            yield from self.iterable
            return
        try:
            for item in self.iterable:
                yield item
                self.update(1)
        finally:
            self.close()

    def update(self, n: float | None = 1) -> bool | None:
        """Count a finished batch.

        Args:
            n: Number of items in the batch.

        Returns:
            Whether the progress was shown anew.
        """
        if self._first_batch is None and n and not self.disable:
            self._first_batch = self.n + n, self._time()
        return super().update(n)

    @property
    def format_dict(self) -> dict[str, Any]:
        """State of the progress, with the rate since the first batch, or a rate of 0 as long as it is unknown."""
        state, rate = super().format_dict, 0.0
        if self._first_batch is not None:
            begin, since = self._first_batch
            rate = (self.n - begin) / max(self._time() - since, 1e-9)
        return {**state, "rate": rate}


class _Lines(_Bar):
    """Progress that is printed as lines instead of a bar."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self._next_line_at = time.monotonic() + FIRST_LINE_S
        super().__init__(*args, **{"mininterval": min(1.0, FIRST_LINE_S), "miniters": 1, "leave": False, **options})

    def clear(self, *_: Any, **__: Any) -> None:
        """Do nothing, because a line that was printed stays."""

    def display(self, *_: Any, **__: Any) -> None:
        """Write a line if it is time for one."""
        if time.monotonic() >= self._next_line_at and (line := self.line()):
            self._next_line_at = time.monotonic() + LOG_INTERVAL_S
            self.fp.write(f"{line}\n")
            self.fp.flush()

    def line(self) -> str:
        """Describe the progress in a sentence; empty before the first batch, and in the first half minute while the
        remaining time is unknown.
        """
        state = self.format_dict
        total = f" of {self._bound}{state['total']:.6g}" if state["total"] else ""
        remaining = ""
        if total and state["rate"]:
            remaining = f", {self._bound}{self.format_interval((state['total'] - self.n) / state['rate'])} to go"
        elif total and (self.n == state["initial"] or state["elapsed"] < LOG_INTERVAL_S):
            return ""
        elapsed = self.format_interval(state["elapsed"])
        return f"{state['prefix'] or 'progress'}: {self.n:.6g}{total} {state['unit']} in {elapsed}{remaining}"

    def close(self) -> None:
        """End the progress and write nothing more."""
        if not self.disable:
            self.disable = True
            self._decr_instances(self)
