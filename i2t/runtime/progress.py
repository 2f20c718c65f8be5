"""Progress of long work: a bar on a terminal, and otherwise a line every half a minute, so that logs stay short.

`TQDM_DISABLE=1` in the environment disables both.
"""

import sys
import time
from collections.abc import Iterable
from typing import Any, TypeAlias

from tqdm import tqdm

LOG_INTERVAL_S = 30.0  # s between progress lines where stderr is not a terminal; shorter work writes no line
Progress: TypeAlias = tqdm  # result of `progress`: an iterable, or a counter with `update`


def progress(items: Iterable[Any] | None = None, *, desc: str = "", unit: str = "step", **options: Any) -> Progress:
    """Show progress on stderr: a bar on a terminal, otherwise a line every half a minute.

    Args:
        items: Items to iterate over; without them, `update` counts.
        desc: Name of the work.
        unit: Unit of the count.
        **options: Options of tqdm, such as `total`.

    Returns:
        An iterable over the items, or a counter.
    """
    terminal = sys.stderr is not None and sys.stderr.isatty()
    return (_Bar if terminal else _Lines)(items, desc=desc, unit=unit, **options)


class _Bar(tqdm):
    """Progress as a bar, which can be closed even if Ctrl-C interrupted its construction."""

    disable: bool = True


class _Lines(_Bar):
    """Progress that is printed as lines instead of a bar."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self._last_line_at = time.monotonic()
        super().__init__(*args, **{"mininterval": LOG_INTERVAL_S, "miniters": 1, "leave": False, **options})

    def display(self, *_: Any, **__: Any) -> None:
        """Write a line, unless the last one is recent."""
        if time.monotonic() - self._last_line_at >= LOG_INTERVAL_S:
            self._last_line_at = time.monotonic()
            self.fp.write(f"{self.line()}\n")
            self.fp.flush()

    def line(self) -> str:
        """Describe the progress in a sentence."""
        state = self.format_dict
        total = f" of {state['total']:.6g}" if state["total"] else ""
        remaining = ""
        if state["total"] and self.n > state["initial"]:
            seconds = state["elapsed"] * (state["total"] - self.n) / (self.n - state["initial"])
            remaining = f", {self.format_interval(seconds)} to go"
        elapsed = self.format_interval(state["elapsed"])
        return f"{state['prefix'] or 'progress'}: {self.n:.6g}{total} {state['unit']} in {elapsed}{remaining}"

    def close(self) -> None:
        """End the progress and write nothing more."""
        if not self.disable:
            self.disable = True
            self._decr_instances(self)
