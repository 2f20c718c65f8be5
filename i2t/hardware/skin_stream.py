"""Skins that send samples continuously: their queue, and the thread that fills it.

A driver derives from `StreamedSkin`, opens its link and receives samples from it; this module implements the rest of
the protocol (`i2t.hardware.protocols.Skin`). Microtesla, in the board's order and axes.
"""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, NamedTuple, SupportsIndex

import numpy as np

from i2t.errors import DeviceError, DeviceTimeoutError, NotConnectedError
from i2t.hardware.base import DeviceBase
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.protocols import Samples, SkinCounters, SkinFeatures, channel_names
from i2t.types import Array, Board


@dataclass(frozen=True)
class StreamConfig:
    """Number of samples that a skin's queue holds, and periods and timeouts (s) of filling and reading it."""

    queue_samples: int = 4096
    poll_period: float = 0.02  # s, maximum time between two looks into the queue
    read_margin: float = 2.0  # s, delay that is allowed for samples, as on a busy computer; the arm stands meanwhile
    max_time_ahead: float = 0.25  # s, largest time by which a sample may be ahead; its time may come from another clock
    first_sample_timeout: float = 3.0  # s, waiting time for the first sample after a connection
    rate_window: float = 1.0  # s, duration over which the rate is measured
    min_rate_span: float = 0.2  # s, shortest span of the samples in the window from which the rate is computed
    join_timeout: float = 1.0  # s, waiting time for the end of the thread


class StreamRow(NamedTuple):
    """One sample of a skin with its number, monotonic time (s), reading (uT) and temperatures (degrees Celsius).

    It is a row of `i2t.hardware.protocols.Samples`.
    """

    number: int
    time: float  # s, monotonic time of the sample
    reading: Array  # (c,) uT, reading of the sample; NaN for a missing chip
    temperature: Array  # (chips,) degrees Celsius, NaN if the board does not report it


class Measurement(NamedTuple):
    """One sample of a skin as its driver receives it, not numbered yet.

    It has a monotonic time (s), a reading (uT) and temperatures (degrees Celsius).
    """

    time: float  # s, monotonic time
    reading: Array  # (c,) uT, reading
    temperature: Array  # (chips,) degrees Celsius


class QueuedSkin(DeviceBase):
    """Base of skins whose samples are kept in a queue, from which `latest`, `read` and `since` take them.

    Code that fills the queue must append rows with rising numbers and hold `lock`.

    Args:
        features: Features of the skin.
        queue: Queue of samples.
        clock: Clock that dates the samples; by default this machine's.
        lock: Lock of the queue; by default a new one.
    """

    stream_config = StreamConfig()

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
        """Name, source, channels, unit and rate of the skin, available before `connect`."""
        return self._features

    @property
    def _name(self) -> str:
        return self._features.name

    def latest(self, timeout: float = 0.4) -> Samples:
        """Return the skin's newest sample without waiting, as in `Skin.latest`."""
        self._check()
        newest = self._after(self._newest - 1)
        age = self._clock.now() - newest[-1].time if newest else np.inf
        if not age <= timeout:
            raise DeviceTimeoutError(self._silence_message(age))
        return self._samples(newest[-1:])

    def read(self, count: int, timeout: float | None = None) -> Samples:
        """Wait for and return the next samples, all measured after the call, as in `Skin.read`."""
        if not 0 < count <= (self._queue.maxlen or 0):
            raise ValueError(f"{count} samples were requested; the queue holds 1 to {self._queue.maxlen}")
        rate = min(self._rate() or self._features.rate, self._features.rate)
        timeout = 2 * count / rate + self.stream_config.read_margin if timeout is None else timeout
        called, newest = self._clock.now(), self._newest
        while True:
            rows = [row for row in self._after(newest) if row.time > called][:count]
            if len(rows) == count:
                return self._samples(rows)
            self._check()
            if not self._clock.now() - called < timeout:
                raise DeviceTimeoutError(
                    f"{self._name} sent {len(rows)} of {count} samples in {timeout:.2g} s; check its cable and its rate"
                )
            self._clock.sleep(min((count - len(rows)) / rate, timeout, self.stream_config.poll_period))

    def since(self, number: SupportsIndex) -> Samples:
        """Return the queued samples after a given one without waiting, as in `Skin.since`."""
        rows = self._after(int(number))
        if not rows:
            self._check()
        return self._samples(rows)

    def _check(self) -> None:
        """Raise the error of a skin that has failed."""

    def _catch_up(self) -> None:
        """Fill the queue up to the present, if no thread does."""

    def _rate(self) -> float:
        """Measure the rate of the samples in Hz; 0 if it is unknown."""
        return 0.0

    def _silence_message(self, age: float) -> str:
        """Describe a skin whose newest sample is `age` seconds old."""
        return f"{self._name} has been silent for {age:.2g} s; check its cable and that it sends"

    @property
    def _newest(self) -> int:
        """Number of the newest sample; -1 before the first."""
        with self._lock:
            self._catch_up()
            return self._queue[-1].number if self._queue else -1

    def _after(self, number: int) -> list[StreamRow]:
        """List the queued samples with higher numbers, up to the present."""
        with self._lock:
            self._catch_up()
            return list(takewhile(lambda row: row.number > number, reversed(self._queue)))[::-1]

    def _samples(self, rows: Sequence[StreamRow]) -> Samples:
        """Convert rows to columns."""
        channels = len(self._features.channels)
        number, times, reading, temperature = zip(*rows, strict=True) if rows else ((), (), (), ())
        readings = np.array(reading, float).reshape(-1, channels)
        temperatures = np.array(temperature, float).reshape(-1, channels // 3)
        return Samples(np.array(number, np.int64), np.array(times, float), readings, temperatures)


class StreamedSkin(QueuedSkin):
    """Base of drivers of skins (`i2t.hardware.protocols.Skin`) whose samples a thread receives into a queue.

    A driver implements

        open_link     open the board and return the link that the other two methods receive
        receive       return the samples that have arrived since the last call, or arrive within about 50 ms
        close_link    close the link, whatever its state

    The skin's `board` describes its chips. Once the thread has ended, for whatever reason, every call raises the reason
    until `connect` is called again.

    Args:
        name: Name of the device, for messages.
        chips: Number of magnetometers.
        rate: Nominal rate in Hz.
        source: "real", "emulated" or "simulated".
        capacity: Number of samples that the queue holds.
    """

    board: Board | None = None

    def __init__(
        self, name: str, chips: int, rate: float, *, source: str = "real", capacity: int = StreamConfig.queue_samples
    ) -> None:
        super().__init__(SkinFeatures(name, source, channel_names(chips), "uT", rate), deque(maxlen=capacity))
        self._failure: DeviceError | None = NotConnectedError(f"{name} is not connected; call connect() or use with")
        self._received = self._connects = 0
        self._arrivals: deque[tuple[float, int]] = deque()  # (time, number of samples by then) of the last second
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()

    # Methods that a driver implements

    def open_link(self) -> Any:
        """Open the link to the board and return it; raise DeviceError if that fails."""
        raise NotImplementedError

    def receive(self, link: Any) -> Sequence[Measurement]:
        """Receive the samples that have arrived from the board; may raise any exception when the board is gone.

        Args:
            link: Link that `open_link` returned.

        Returns:
            The samples in order; may be empty.
        """
        raise NotImplementedError

    def close_link(self, link: Any) -> None:
        """Close the link to the board, whatever its state.

        Args:
            link: Link that `open_link` returned.
        """

    # Methods of a skin

    @property
    def counters(self) -> SkinCounters:
        """Counts of samples since the first connection; a driver adds its counts of losses."""
        with self._lock:
            return SkinCounters(samples=self._received, connects=self._connects, rate=self._rate())

    def connect(self) -> None:
        """Open the board and wait for its first sample; raise DeviceError if that fails."""
        self.close()
        try:
            link = self.open_link()
        except DeviceError:
            raise
        except Exception as error:  # a library may raise anything
            raise self._lost_error(error) from error
        with self._lock:
            self._failure, self._connects = None, self._connects + 1
            self._arrivals.clear()
            self._stop, before = threading.Event(), self._received
        self._thread = threading.Thread(target=self._receive, args=(link, self._stop), name=self._name, daemon=True)
        self._thread.start()
        try:
            timeout = self.stream_config.first_sample_timeout
            deadline = time.monotonic() + timeout
            while self._received == before:
                self._check()
                if not time.monotonic() <= deadline:
                    raise DeviceTimeoutError(self._silence_message(timeout))
                time.sleep(self.stream_config.poll_period / 4)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop receiving, and release the board as soon as `receive` returns; never raises."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(self.stream_config.join_timeout)
        self._thread = None
        self._fail(NotConnectedError(f"{self._name} was closed; connect it again"))

    def _receive(self, link: Any, stop: threading.Event) -> None:
        """Fill the queue until `stop` is set or the board is gone."""
        try:
            while not stop.is_set():
                self._accept(self.receive(link), stop)
        except DeviceError as error:
            self._fail(error, stop)
        except BaseException as error:  # a library may raise anything
            self._fail(self._lost_error(error), stop)
        finally:
            with contextlib.suppress(Exception):
                self.close_link(link)

    def _accept(self, measured: Sequence[Measurement], stop: threading.Event) -> None:
        """Queue new samples, unless their connection was closed meanwhile."""
        now, chips = time.monotonic(), len(self._features.channels) // 3
        for row in measured:
            if (np.shape(row.reading), np.shape(row.temperature)) != ((3 * chips,), (chips,)):
                raise DeviceError(f"{self._name} sends samples that do not have {3 * chips} values; check its driver")
            if not row.time <= now + self.stream_config.max_time_ahead:
                raise DeviceError(
                    f"{self._name} sends samples with times in the future; its driver must use time.monotonic()"
                )
        with self._lock:
            if not measured or stop.is_set():
                return
            for row in measured:
                self._queue.append(StreamRow(self._received, *row))
                self._received += 1
            self._arrivals.append((now, self._received))
            while now - self._arrivals[0][0] > self.stream_config.rate_window:
                self._arrivals.popleft()

    def _lost_error(self, error: BaseException) -> DeviceError:
        """Describe the loss of a board."""
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
        """Measure the rate in Hz over the last second, with `more` samples that arrive now."""
        now = time.monotonic()
        with self._lock:
            arrivals = [*self._arrivals, *([(now, self._received + more)] if more else [])]
        arrivals = [arrival for arrival in arrivals if now - arrival[0] <= self.stream_config.rate_window]
        if len(arrivals) < 2:
            return 0.0
        (start, first), (end, last) = arrivals[0], arrivals[-1]
        return (last - first) / (end - start) if end - start > self.stream_config.min_rate_span else 0.0
