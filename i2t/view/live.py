"""Scene "live": the readings of a running skin, thirty times a second, with its rate, losses and health.

The samples are read, and recorded, in a thread of their own, so that a slow browser loses none.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.errors import DeviceError
from i2t.hardware.protocols import Samples, Skin, SkinCounters
from i2t.hardware.reskin.monitor import REST_SAMPLES, SHOWN_SAMPLES, judge_rest, sample_recorder
from i2t.prediction.touch_model import Reading
from i2t.skin.boards import mean_finite
from i2t.skin_models.calibration import Calibration, PressEstimate
from i2t.types import Board
from i2t.view.drawing import SkinNode
from i2t.view.server import Page

FRAME_S = 1 / 30  # s, time from one picture to the next
TOUCHED_UT, MAX_MISFIT = 20.0, 5.0  # uT and standard deviations, between which a contact has a place


class Live(NamedTuple):
    """State of the scene: the newest samples, the reading at rest, and what is known of the skin."""

    name: str  # name and source of the skin
    board: Board
    calibration: Calibration | None
    message: str = "waiting for the skin ..."
    rest: Float[np.ndarray, " c"] | None = None  # uT, reading at rest
    change: Float[np.ndarray, " c"] | None = None  # uT, mean of the newest samples less the reading at rest
    health: str = "the first samples define zero"
    place: PressEstimate | None = None
    fps: float = 0.0  # pictures a second
    recording: str = ""  # path of the table that is written


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

    path: str  # empty if it ended


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
            mean = mean_finite(samples.reading, axis=0)
            change = None if state.rest is None else mean - state.rest
            lines = [
                f"**{state.name}** {counters.rate:.0f} Hz, {counters.samples} samples, lost {counters.lost} "
                f"({100 * counters.loss:.2f} %), {fps:.0f} pictures a second",
                state.health,
            ]
            where = None
            if change is not None and np.isfinite(change).all():
                size = float(np.linalg.norm(change))
                lines.append(f"change of all chips: {size:.1f} µT")
                if state.calibration is not None and size > TOUCHED_UT:
                    where = state.calibration.locate(change)
                    lines.append(_worded(where, state.calibration.load_kind))
            if state.recording:
                lines.append(f"recording to {state.recording}")
            return state._replace(change=change, place=where, fps=fps, message="\n\n".join(lines))
        case Zeroed(samples):
            rest, health = judge_rest(samples)
            return state._replace(rest=rest, health=health)
        case Recorded(path):
            return state._replace(recording=path)
        case Lost(reason):
            return state._replace(change=None, place=None, recording="", message=f"**{state.name}:** {reason}")
    return state


def _worded(where: PressEstimate, load_kind: str) -> str:
    if not where.misfit <= MAX_MISFIT:
        return f"unlike the calibration's presses ({where.misfit:.0f} standard deviations), so without a place"
    (x, y), (dx, dy) = 1e3 * where.position, 1e3 * where.position_std
    return f"contact at x {x:.1f} ± {dx:.1f} mm, y {y:.1f} ± {dy:.1f} mm (loads: {load_kind})"


class LiveScene:
    """Nodes, widgets and the thread of the scene, which holds the skin until it is closed.

    Args:
        skin: The skin, not connected.
        board: Its board.
        calibration: Calibration of this skin, from which the place of a contact follows.
        record: Table to write when "record" is pressed; a number is added to its name if it exists.
        stack: Stack that ends what was started for the skin.
    """

    def __init__(
        self, skin: Skin, board: Board, calibration: Calibration | None, record: Path, stack: ExitStack
    ) -> None:
        self.state = Live(f"{skin.features.name} ({skin.features.source})", board, calibration)
        self.update = update
        self._skin, self._path, self._stack = skin, record, stack
        self._stop, self._thread = threading.Event(), threading.Thread(target=self._read, name="live", daemon=True)
        self._recording = ExitStack()
        self._write: Callable[[], None] | None = None
        self._lock = threading.Lock()
        self._zero_from: int | None = -1  # number of the sample from which zero is measured; -1 for the next one
        self._frames: deque[float] = deque(maxlen=30)  # s, times of the newest pictures

    def build(self, page: Page) -> None:
        """Add the skin and the widgets, and begin to read."""
        self._page, gui = page, page.server.gui
        edge = 0.02
        page.look_at(np.array([[-edge, -edge, 0], [edge, edge, edge]]))
        self._node = SkinNode(page.server.scene, "/tool", lift=0.0)
        self._dot = page.server.scene.add_icosphere("/tool/place", radius=1e-3, color=(0, 0, 0), visible=False)
        gui.add_button("zero").on_click(lambda _: setattr(self, "_zero_from", -1))
        gui.add_button("record").on_click(lambda _: self._toggle())
        gui.add_button("connect again").on_click(lambda _: self._connect())
        self._scale = gui.add_slider("scale (µT)", 5, 500, 5, 50)
        self._connect()
        self._thread.start()

    def draw(self, state: Live) -> None:
        """Show the newest samples."""
        self._frames.append(time.monotonic())
        if state.change is not None:
            reading = Reading(state.change, np.zeros_like(state.change))
            self._node.draw(state.board, {"measured": reading}, float(self._scale.value))
        seen = state.place is not None and state.place.misfit <= MAX_MISFIT
        self._dot.visible = seen
        if state.place is not None and seen:
            self._dot.position = (*state.place.position, 0.0)

    def close(self) -> None:
        """End recording and reading, and release the skin."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5)
        self._end_recording()
        self._skin.close()
        self._stack.close()

    def _connect(self) -> None:
        try:
            self._skin.connect()
            self._zero_from = -1
        except DeviceError as error:
            self._page.send(Lost(str(error)))

    def _read(self) -> None:
        """Record and show samples until the scene is closed; a skin that is gone may be connected again."""
        lost = False
        while not self._stop.wait(FRAME_S):
            try:
                newest = int(self._skin.latest().number[-1])
                lost = False
                with self._lock:
                    if self._write is not None:
                        self._write()
                if self._zero_from == -1:
                    self._zero_from = newest
                if self._zero_from is not None and newest - self._zero_from >= REST_SAMPLES:
                    self._page.send(Zeroed(self._skin.since(self._zero_from)))
                    self._zero_from = None
                fps = (len(self._frames) - 1) / max(self._frames[-1] - self._frames[0], 1e-9) if self._frames else 0.0
                self._page.send(Ticked(self._skin.since(newest - SHOWN_SAMPLES), self._skin.counters, fps))
            except (DeviceError, OSError) as error:
                if not lost:
                    self._end_recording()
                    self._page.send(Recorded(""))
                    self._page.send(Lost(str(error)))
                lost = True

    def _toggle(self) -> None:
        """Begin or end recording."""
        with self._lock:
            recording = self._write is not None
        if recording:
            self._end_recording()
            self._page.send(Recorded(""))
            return
        path, number = self._path, 1
        while path.exists():
            number += 1
            path = self._path.with_stem(f"{self._path.stem}-{number}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = path.open("x", newline="", buffering=1)
            write = sample_recorder(self._skin, file)
        except (DeviceError, OSError) as error:
            self._page.say(f"not recorded: {error}")
            return
        with self._lock:
            self._recording.push(file)
            self._write = write
        self._page.send(Recorded(str(path)))

    def _end_recording(self) -> None:
        """Write the last samples and close the table."""
        with self._lock:
            write, self._write = self._write, None
            if write is not None:
                write()
            self._recording.close()
