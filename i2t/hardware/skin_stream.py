"""Skins whose samples come by themselves: their queue, and the thread that fills it.

A driver derives from `StreamedSkin`, opens its link and receives samples from it; the rest of the protocol
(`i2t.hardware.protocols.Skin`) is here. Microtesla, in the board's order and axes.
"""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Sequence
from itertools import takewhile
from typing import Any, NamedTuple, SupportsIndex

import numpy as np

from i2t.errors import DeviceError, DeviceTimeoutError, NotConnectedError
from i2t.hardware.base import DeviceBase
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.protocols import READ_SPARE_S, Samples, SkinCounters, SkinFeatures, channel_names
from i2t.types import Array, Board

QUEUE_SAMPLES = 4096
LONGEST_WAIT_S = 0.02  # between two looks into the queue
MOST_AHEAD_S = 0.25  # of a sample's time, which may be that of another clock's beat
FIRST_SAMPLE_S = 3.0  # in which a skin that was connected must have sent something
RATE_WINDOW_S, LEAST_RATE_WINDOW_S = 1.0, 0.2  # over which the rate is taken
JOIN_S = 1.0  # in which the thread ends


class StreamRow(NamedTuple):
    """One sample; see `i2t.hardware.protocols.Samples`."""

    number: int
    time: float  # s
    reading: Array  # (c,) uT, NaN for a chip that is missing
    temperature: Array  # (chips,) degrees Celsius, NaN where the board does not tell


class Measurement(NamedTuple):
    """What a driver receives: a sample that has no number yet."""

    time: float  # s, monotonic
    reading: Array  # (c,) uT
    temperature: Array  # (chips,) degrees Celsius


class QueuedSkin(DeviceBase):
    """A skin whose samples wait in a queue; whoever fills it appends rows with rising numbers, and holds `lock`.

    Args:
        features: Known before it is connected.
        queue: Of samples.
        clock: That dates them; by default this machine's.
        lock: Of the queue.
    """

    def __init__(
        self,
        features: SkinFeatures,
        queue: deque[StreamRow],
        clock: Clock | None = None,
        lock: "threading.RLock | None" = None,
    ) -> None:
        self._features, self._queue = features, queue
        self._clock, self._lock = clock or MonotonicClock(), lock or threading.RLock()

    @property
    def features(self) -> SkinFeatures:
        """Features, known before `connect`."""
        return self._features

    @property
    def _name(self) -> str:
        return self._features.name

    def latest(self, timeout: float = 0.4) -> Samples:
        """The newest sample, at once, as in `Skin.latest`."""
        self._check()
        newest = self._after(self._newest - 1)
        age = self._clock.now() - newest[-1].time if newest else np.inf
        if not age <= timeout:
            raise DeviceTimeoutError(self._silence(age))
        return self._samples(newest[-1:])

    def read(self, count: int, timeout: float | None = None) -> Samples:
        """The next samples, all measured after the call, as in `Skin.read`."""
        if not 0 < count <= (self._queue.maxlen or 0):
            raise ValueError(f"{count} samples were asked for; the queue holds 1 to {self._queue.maxlen}")
        rate = min(self._rate() or self._features.rate, self._features.rate)
        timeout = 2 * count / rate + READ_SPARE_S if timeout is None else timeout
        called, newest = self._clock.now(), self._newest
        while True:
            got = [row for row in self._after(newest) if row.time > called][:count]
            if len(got) == count:
                return self._samples(got)
            self._check()
            if not self._clock.now() - called < timeout:
                raise DeviceTimeoutError(
                    f"{self._name} gave {len(got)} of {count} samples in {timeout:.2g} s; check its cable and its rate"
                )
            self._clock.sleep(min((count - len(got)) / rate, timeout, LONGEST_WAIT_S))

    def since(self, number: SupportsIndex) -> Samples:
        """Samples after a given one that are still in the queue, without waiting, as in `Skin.since`."""
        got = self._after(int(number))
        if not got:
            self._check()
        return self._samples(got)

    def _check(self) -> None:
        """Raise what is wrong."""

    def _catch_up(self) -> None:
        """Fill the queue up to the present, where nobody else does."""

    def _rate(self) -> float:
        """Hz, at which samples come; 0 where it is not known."""
        return 0.0

    def _silence(self, age: float) -> str:
        """Sentence on a skin whose newest sample is so old (s)."""
        return f"{self._name} has been silent for {age:.2g} s; check its cable and that it sends"

    @property
    def _newest(self) -> int:
        """Number of the newest sample; -1 before the first."""
        with self._lock:
            self._catch_up()
            return self._queue[-1].number if self._queue else -1

    def _after(self, number: int) -> list[StreamRow]:
        """Queued samples of higher numbers, up to the present."""
        with self._lock:
            self._catch_up()
            return list(takewhile(lambda row: row.number > number, reversed(self._queue)))[::-1]

    def _samples(self, rows: Sequence[StreamRow]) -> Samples:
        """Rows as columns; maybe none."""
        channels = len(self._features.channels)
        number, times, reading, temperature = zip(*rows, strict=True) if rows else ((), (), (), ())
        readings = np.array(reading, float).reshape(-1, channels)
        temperatures = np.array(temperature, float).reshape(-1, channels // 3)
        return Samples(np.array(number, np.int64), np.array(times, float), readings, temperatures)


class StreamedSkin(QueuedSkin):
    """A skin (`i2t.hardware.protocols.Skin`) whose samples a thread receives. Its `board` says where its chips are.
    A driver gives

        open_link     to the board, which is what the other two are called with
        receive       the samples that have come since the last call, or come within some 50 ms; maybe none
        close_link    whatever state it is in

    Once the thread has ended, for whatever reason, every call says why until `connect` is called again.

    Args:
        name: Of the device, for messages.
        chips: How many magnetometers it has.
        rate: Hz, nominal.
        source: real, emulated or simulated.
        capacity: Samples that the queue holds.
    """

    board: Board | None = None

    def __init__(
        self, name: str, chips: int, rate: float, *, source: str = "real", capacity: int = QUEUE_SAMPLES
    ) -> None:
        super().__init__(SkinFeatures(name, source, channel_names(chips), "uT", rate), deque(maxlen=capacity))
        self._failure: DeviceError | None = NotConnectedError(f"{name} is not connected; call connect() or use with")
        self._received = self._connects = 0
        self._arrivals: deque[tuple[float, int]] = deque()  # (time, samples by then), the last second
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()

    # What a driver gives

    def open_link(self) -> Any:
        """Open the board; raises DeviceError."""
        raise NotImplementedError

    def receive(self, link: Any) -> Sequence[Measurement]:
        """The samples that have come; raises whatever its library raises when the board is gone.

        Args:
            link: As `open_link` gave it.

        Returns:
            Samples in order; maybe none.
        """
        raise NotImplementedError

    def close_link(self, link: Any) -> None:
        """Give the board back.

        Args:
            link: As `open_link` gave it.
        """

    # What it has by that

    @property
    def counters(self) -> SkinCounters:
        """Counts so far; a driver adds what it knows of losses."""
        with self._lock:
            return SkinCounters(samples=self._received, connects=self._connects, rate=self._rate())

    def connect(self) -> None:
        """Open the board and wait for its first sample; raises DeviceError."""
        self.close()
        try:
            link = self.open_link()
        except DeviceError:
            raise
        except Exception as error:  # a library may raise anything
            raise self._lost(error) from error
        with self._lock:
            self._failure, self._connects = None, self._connects + 1
            self._arrivals.clear()
            self._stop, before = threading.Event(), self._received
        self._thread = threading.Thread(target=self._receive, args=(link, self._stop), name=self._name, daemon=True)
        self._thread.start()
        try:
            until = time.monotonic() + FIRST_SAMPLE_S
            while self._received == before:
                self._check()
                if not time.monotonic() <= until:
                    raise DeviceTimeoutError(self._silence(FIRST_SAMPLE_S))
                time.sleep(LONGEST_WAIT_S / 4)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop receiving, and give the board back as soon as `receive` returns; raises nothing."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(JOIN_S)
        self._thread = None
        self._fail(NotConnectedError(f"{self._name} was closed; connect it again"))

    def _receive(self, link: Any, stop: threading.Event) -> None:
        """Fill the queue until told to stop, or until the board is gone."""
        try:
            while not stop.is_set():
                self._accept(self.receive(link), stop)
        except DeviceError as error:
            self._fail(error, stop)
        except BaseException as error:  # a library may raise anything
            self._fail(self._lost(error), stop)
        finally:
            with contextlib.suppress(Exception):
                self.close_link(link)

    def _accept(self, measured: Sequence[Measurement], stop: threading.Event) -> None:
        """Queue samples that have come now, unless they are of a connection that was closed meanwhile."""
        now, chips = time.monotonic(), len(self._features.channels) // 3
        for row in measured:
            if (np.shape(row.reading), np.shape(row.temperature)) != ((3 * chips,), (chips,)):
                raise DeviceError(
                    f"{self._name} sends samples of another shape than {3 * chips} values; see its driver"
                )
            if not row.time <= now + MOST_AHEAD_S:
                raise DeviceError(f"{self._name} dates samples into the future; its driver must use time.monotonic()")
        with self._lock:
            if not measured or stop.is_set():
                return
            for row in measured:
                self._queue.append(StreamRow(self._received, *row))
                self._received += 1
            self._arrivals.append((now, self._received))
            while now - self._arrivals[0][0] > RATE_WINDOW_S:
                self._arrivals.popleft()

    def _lost(self, error: BaseException) -> DeviceError:
        """What is said of a board that is gone."""
        lost = DeviceError(f"{self._name} is gone ({error}); plug it in and connect again")
        lost.__cause__ = error
        return lost

    def _fail(self, error: DeviceError, stop: threading.Event | None = None) -> None:
        with self._lock:
            if stop is None or not stop.is_set():
                self._failure = self._failure or error

    def _check(self) -> None:
        if self._failure is not None:
            raise type(self._failure)(*self._failure.args) from self._failure.__cause__

    def _rate(self, more: int = 0) -> float:
        """Hz over the last second, with so many samples that come now."""
        now = time.monotonic()
        with self._lock:
            arrivals = [*self._arrivals, *([(now, self._received + more)] if more else [])]
        arrivals = [each for each in arrivals if now - each[0] <= RATE_WINDOW_S]
        if len(arrivals) < 2:
            return 0.0
        (start, first), (end, last) = arrivals[0], arrivals[-1]
        return (last - first) / (end - start) if end - start > LEAST_RATE_WINDOW_S else 0.0
