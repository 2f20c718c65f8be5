"""Progress of long work: a bar on a terminal, and elsewhere a line now and then, so that a log is no heap of redraws.

`TQDM_DISABLE=1` in the environment silences both.
"""

import sys
import time
from collections.abc import Iterable
from typing import Any, TypeAlias

from tqdm import tqdm

LOG_INTERVAL_S = 30.0  # between lines where the output is no terminal; what is quicker says nothing
Progress: TypeAlias = tqdm  # what `progress` gives: to count with `update`, or to go through


def progress(items: Iterable[Any] | None = None, *, desc: str = "", unit: str = "step", **options: Any) -> Progress:
    """Show progress on stderr: a bar if that is a terminal, else a line every half a minute.

    Args:
        items: To go through; without them `update` counts.
        desc: What is done.
        unit: Of what is counted.
        **options: Of tqdm, such as `total`.

    Returns:
        What goes through the items, or counts.
    """
    terminal = sys.stderr is not None and sys.stderr.isatty()
    return (_Bar if terminal else _Lines)(items, desc=desc, unit=unit, **options)


class _Bar(tqdm):
    """Progress as a bar, which can be closed when Ctrl-C has come while it was made."""

    disable: bool = True


class _Lines(_Bar):
    """Progress as lines."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self._told_at = time.monotonic()
        super().__init__(*args, **{"mininterval": LOG_INTERVAL_S, "miniters": 1, "leave": False, **options})

    def display(self, *_: Any, **__: Any) -> None:
        """Write a line, unless one was written just now."""
        if time.monotonic() - self._told_at >= LOG_INTERVAL_S:
            self._told_at = time.monotonic()
            print(self.line(), file=sys.stderr, flush=True)

    def line(self) -> str:
        """Progress in words."""
        about = self.format_dict
        of = f" of {about['total']:.6g}" if about["total"] else ""
        ahead = ""
        if about["total"] and self.n > about["initial"]:
            left = about["elapsed"] * (about["total"] - self.n) / (self.n - about["initial"])
            ahead = f", {self.format_interval(left)} to go"
        took = self.format_interval(about["elapsed"])
        return f"{about['prefix'] or 'progress'}: {self.n:.6g}{of} {about['unit']} in {took}{ahead}"

    def close(self) -> None:
        """Stop the output."""
        if not self.disable:
            self.disable = True
            self._decr_instances(self)
