"""Scene "live": the readings of a running skin, thirty times a second, with its rate, losses and health.

The samples are read, and recorded, in a thread of their own, so that a slow browser loses none.
"""

import itertools
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.errors import DeviceError, DeviceTimeoutError
from i2t.hardware.protocols import Samples, Skin, SkinCounters
from i2t.hardware.reskin.monitor import REST_SAMPLES, SHOWN_SAMPLES, judge_rest, record_samples
from i2t.patches.dimensions import PAD_WINDOW
from i2t.skin.boards import mean_finite
from i2t.skin_models.calibration import Calibration, PressEstimate
from i2t.types import Board
from i2t.view.drawing import SkinNode, measured
from i2t.view.server import Page, Scene

log = logging.getLogger(__name__)
FRAME_S = 1 / 30  # s, time from one picture to the next
MAX_MISFIT = 3.0  # standard deviations, beyond which a reading is unlike those of the calibration


class Live(NamedTuple):
    """State of the scene: the newest samples, the reading at rest, and what is known of the skin."""

    name: str  # name and source of the skin
    board: Board
    calibration: Calibration | None
    status: str = "waiting for the skin ..."  # lines about the stream and the reading
    rest: Float[np.ndarray, " c"] | None = None  # uT, reading at rest
    change: Float[np.ndarray, " c"] | None = None  # uT, mean of the newest samples less the reading at rest
    health: str = "the first samples define zero"
    place: PressEstimate | None = None
    recording: str = ""  # sentence about the table that is written, or was last

    @property
    def message(self) -> str:
        """All that is known of the skin, in lines."""
        return "\n".join(filter(None, [self.status, self.recording]))


class Ticked(NamedTuple):
    """Event: the newest samples of the skin, and its counters."""

    samples: Samples
    counters: SkinCounters
    fps: float


class Zeroed(NamedTuple):
    """Event: the samples of a skin that touches nothing."""

    samples: Samples


class Recorded(NamedTuple):
    """Event: recording began or ended."""

    sentence: str


class Lost(NamedTuple):
    """Event: the skin is gone."""

    reason: str


def update(state: Live, event: Any) -> Live:
    """Take new samples, or a new zero.

    Args:
        state: The state before the event.
        event: The event, of one of this module's types.

    Returns:
        The state after it.
    """
    match event:
        case Ticked(samples, counters, fps):
            change = None if state.rest is None else mean_finite(samples.reading, axis=0) - state.rest
            lines = [
                state.name,
                f"{counters.rate:.0f} Hz, {counters.samples} samples, lost {counters.lost} "
                f"({100 * counters.loss:.2f} %), {fps:.0f} updates a second",
                state.health,
            ]
            where = None
            if change is not None:
                size = float(np.linalg.norm(change[np.isfinite(change)]))
                lines.append(f"change of all chips: {size:.1f} µT")
                if state.calibration is not None and size > 20:  # uT, well above the noise
                    where = state.calibration.locate(change) if np.isfinite(change).all() else None
                    lines.append(_worded(where))
            return state._replace(change=change, place=where, status="\n".join(lines))
        case Zeroed(samples):
            rest, health = judge_rest(samples)
            return state._replace(rest=rest, health=health)
        case Recorded(sentence):
            return state._replace(recording=sentence)
        case Lost(reason):
            return state._replace(change=None, place=None, status=f"{state.name}\n{reason}")
    return state


def _worded(where: PressEstimate | None) -> str:
    if where is None:
        return "no position, because a chip does not answer"
    if not where.misfit <= MAX_MISFIT:
        return f"no position: the reading differs from every calibrated press by {where.misfit:.0f} standard deviations"
    (x, y), (dx, dy) = 1e3 * where.position, 1e3 * where.position_std
    return f"contact at x {x:.1f} ± {dx:.1f} mm, y {y:.1f} ± {dy:.1f} mm, by the calibration"


class LiveScene(Scene):
    """Nodes, widgets and the thread of the scene, which holds the skin until it is closed.

    Args:
        skin: The skin, not connected.
        board: Its board.
        calibration: Calibration of this skin, from which the place of a contact follows.
        table: Table to write when "record" is pressed; a number is added to its name if it exists.
        stack: Stack that ends what was started for the skin.
    """

    update = staticmethod(update)
    ticks = (Ticked,)

    def __init__(
        self, skin: Skin, board: Board, calibration: Calibration | None, table: Path, stack: ExitStack
    ) -> None:
        super().__init__(Live(f"{skin.features.name} ({skin.features.source})", board, calibration))
        self._skin, self._path, self._stack = skin, table, stack
        self._stop, self._thread = threading.Event(), threading.Thread(target=self._read, name="live", daemon=True)
        self._connects, self._zeroes, self._records = True, True, False  # whether these are wanted
        self._connected = False
        self._zero_from: int | None = None  # number of the sample from which zero is measured
        self._write: Callable[[], int] | None = None  # writes the samples since its last call, counts all
        self._rows = 0  # number of samples in the table
        self._table, self._table_path = ExitStack(), table  # the table that is written, or was last
        self._drawn: deque[float] = deque(maxlen=30)  # s, times of the newest pictures

    def build(self, page: Page) -> None:
        """Add the skin and the widgets, and begin to read.

        Args:
            page: The page.
        """
        self._page, gui, scene = page, page.server.gui, page.server.scene
        half = PAD_WINDOW / 2
        page.look_at(np.array([[-half, -half, 0], [half, half, 0]]))
        self._node = SkinNode(scene, "/tool", lift=0.0)
        self._dot = scene.add_icosphere("/tool/place", radius=1e-3, color=(0, 0, 0), visible=False)
        gui.add_button("zero").on_click(lambda _: setattr(self, "_zeroes", True))
        gui.add_button("record").on_click(lambda _: setattr(self, "_records", not self._records))
        gui.add_button("connect again").on_click(lambda _: setattr(self, "_connects", True))
        self._scale = gui.add_slider("scale (µT)", 5, 500, 5, 50)
        self._thread.start()

    def draw(self, state: Live) -> None:
        """Show the newest samples.

        Args:
            state: The state to show.
        """
        self._drawn.append(time.monotonic())
        if state.change is None:
            self._node.clear()
        else:
            self._node.draw(state.board, {"measured": measured(state.change)}, float(self._scale.value))
        seen = state.place is not None and state.place.misfit <= MAX_MISFIT
        self._dot.visible = seen
        if state.place is not None and seen:
            self._dot.position = (*state.place.position, 0.0)

    def close(self) -> None:
        """End recording and reading, and release the skin."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5)
        self._skin.close()
        self._stack.close()

    def _read(self) -> None:
        """Record and show samples until the scene is closed; a skin that is gone may be connected again."""
        due = time.monotonic()
        while not self._stop.wait(max(0.0, due - time.monotonic())):
            due = max(due + FRAME_S, time.monotonic())
            try:
                self._read_once()
            except Exception as error:  # a plug-in may raise anything
                if not isinstance(error, DeviceError):
                    log.exception("the skin could not be read")
                if not isinstance(error, DeviceTimeoutError):  # a silent skin may send again
                    self._connected = False
                    self._end_table(f"recording ended: {error}" if self._write is not None else "")
                self._page.send(Lost(str(error)))
        self._end_table()

    def _read_once(self) -> None:
        """Connect the skin and begin or end recording as wanted, write the new samples, and show the newest."""
        if self._connects:
            self._connects = False
            self._skin.connect()
            self._connected = True
        try:
            if self._records != (self._write is not None):
                (self._begin_table if self._records else self._end_table)()
            if self._write is not None:
                self._rows = self._write()
        except (DeviceError, OSError) as error:
            self._end_table(f"not recorded: {error}" if self._write is None else f"recording ended: {error}")
        if self._connected:
            self._show_newest()

    def _show_newest(self) -> None:
        """Send the newest samples to the page, and zero once there are enough."""
        newest = int(self._skin.latest().number[-1])
        if self._zeroes:
            self._zeroes, self._zero_from = False, newest
        if self._zero_from is not None and newest - self._zero_from >= REST_SAMPLES:
            self._page.send(Zeroed(self._skin.since(self._zero_from)))
            self._zero_from = None
        fps = (len(self._drawn) - 1) / max(self._drawn[-1] - self._drawn[0], 1e-3) if self._drawn else 0.0
        self._page.send(Ticked(self._skin.since(newest - SHOWN_SAMPLES), self._skin.counters, fps))

    def _begin_table(self) -> None:
        path = _unused(self._path)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._write, self._table_path = self._table.enter_context(record_samples(self._skin, path)), path
        self._tell(f"recording to {path}")

    def _end_table(self, why: str = "") -> None:
        """Write the last samples, close the table, and tell how many it holds and why it ended."""
        write, self._write, self._records = self._write, None, False
        with suppress(OSError):  # the disk may be full
            self._rows = write() if write is not None else 0
        with suppress(OSError):
            self._table.close()
        if write is not None:
            why = "; ".join(filter(None, [why, f"{self._table_path} holds {self._rows} samples"]))
        if why:
            self._tell(why)

    def _tell(self, sentence: str) -> None:
        log.info(sentence)
        self._page.send(Recorded(sentence))


def _unused(path: Path) -> Path:
    """Add a number to the name of a file that exists."""
    names = (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))
    return path if not path.exists() else next(name for name in names if not name.exists())
