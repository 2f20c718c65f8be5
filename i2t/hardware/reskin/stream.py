"""A skin whose bytes come through a port: one thread reads, decodes (`i2t.hardware.reskin.frames`) and queues.

Once that thread has ended, for whatever reason, every call says why until `connect` is called again. A sample's time is
that of the read that brought its last byte, less what came after it in the same read at the board's rate.
"""

import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, SupportsIndex, TypeAlias

import numpy as np

from i2t.errors import DeviceError, DeviceTimeoutError, NotConnectedError
from i2t.hardware.base import DeviceBase
from i2t.hardware.protocols import READ_SPARE_S, Samples, SkinCounters, SkinFeatures, channel_names
from i2t.hardware.reskin import frames, recording
from i2t.hardware.reskin.frames import Decoder, Frame, FrameLimits
from i2t.hardware.reskin.layouts import Format

PORT_BUFFER_BYTES = 4000  # a Linux terminal holds 4095, so that a read this long may come after an overflow
FIRST_BYTE_S = 3.0  # that a board may need to start after its port is opened
FIRST_FRAME_S = 1.0  # from its first byte to its first frame, of a board that sends much
SLOW_FRAMES_S = 6.0  # likewise, of one that sends so little that few frames can have come
START_UP_S = 6.0  # that a board may send rubbish after it was reset, which opening its port may do
RATE_WINDOW_S = 1.0  # over which the rate is taken
JOIN_S = 1.0  # in which the thread ends
DECODER_COUNTS = ("samples", "lost", "gaps", "skipped", "empty", "missing", "bytes")

# A serial port or a played recording: `in_waiting`, `read` and `close`. No protocol, as a check of types at run time
# would ask a port how much is waiting that may be gone.
Port: TypeAlias = Any


class StreamRow(NamedTuple):
    """One sample; see `i2t.hardware.protocols.Samples`."""

    number: int
    time: float  # s
    reading: np.ndarray  # (c,) uT, NaN for a chip that is missing
    temperature: np.ndarray  # (chips,) degrees Celsius, NaN where the board does not tell


class BoardInfo(NamedTuple):
    """Properties of a connected board."""

    port: str
    baud: int | None
    form: Format
    description: str = ""  # as USB tells it
    serial_number: str | None = None
    usb: str | None = None  # vendor and product


class Stream(DeviceBase):
    """A skin whose bytes come through something with the face of a serial port; `_open` gives it.

    Args:
        name: Of the skin, for messages.
        source: Real, emulated or replay.
        chips: How many magnetometers the board has.
        rate: Hz, nominal.
        limits: What can be true of a frame.
        capacity: Samples that the queue holds.
    """

    def __init__(
        self, name: str, source: str, *, chips: int, rate: float, limits: FrameLimits | None, capacity: int
    ) -> None:
        self._features = SkinFeatures(name, source, channel_names(chips), "uT", rate)
        self._chips = chips
        self._limits = limits or FrameLimits()
        self._queue: deque[StreamRow] = deque(maxlen=capacity)
        self._changed = threading.Condition()  # guards what the thread and the calls share
        self._counters = SkinCounters()  # of earlier connections, and of the computer
        self._decoder = Decoder()
        self._newest_given = -1  # newest sample that `since` has handed out
        self._arrivals: deque[tuple[float, int]] = deque()  # (time, samples by then), the last second
        self._failure: DeviceError | None = NotConnectedError(
            f"{self._name} is not connected; call connect() or use with"
        )
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._listened = -np.inf  # s, when the thread last came back from the port
        self._file: BinaryIO | None = None
        self._info: BoardInfo | None = None

    # What a user of any skin holds.

    @property
    def features(self) -> SkinFeatures:
        """Features, known before `connect`."""
        return self._features

    @property
    def info(self) -> BoardInfo:
        """Port, speed, format and USB names; raises NotConnectedError before the first connection."""
        if self._info is None:
            raise NotConnectedError(f"{self._name} has not been connected yet, so nothing is known of its board")
        return self._info

    @property
    def counters(self) -> SkinCounters:
        """Counts so far."""
        with self._changed:
            return self._total()._replace(rate=self._rate())

    def connect(self) -> None:
        """Open the port and wait for the first frames.

        Raises:
            DeviceError: There is no such board, or it does not send frames.
        """
        self.close()
        port, decoder, found, self._info = self._open()
        with self._changed:
            self._counters = self._total()._replace(connects=self._counters.connects + 1)
            self._failure = None
            self._arrivals.clear()
            self._accept(decoder, found, time.monotonic())
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read_loop, args=(port, self._stop), name=self._name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop reading and give the port back."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(JOIN_S)  # a read ends within a tick
        self._thread = None
        self.stop_recording()
        self._fail(NotConnectedError(f"{self._name} was closed; connect it again"))

    def latest(self, timeout: float = 0.4) -> Samples:
        """The newest sample, at once, as in `Skin.latest`.

        Raises:
            DeviceTimeoutError: It is older than the timeout (s).
            DeviceError: The skin is not connected or gone.
        """
        with self._changed:
            self._check()
            age = time.monotonic() - self._queue[-1].time
            if age > timeout:
                raise DeviceTimeoutError(self._silence(age))
            return self._samples([self._queue[-1]])

    def read(self, count: int, timeout: float | None = None) -> Samples:
        """The next samples, all measured after the call, as in `Skin.read`.

        Raises:
            DeviceTimeoutError: They did not come in time.
            DeviceError: The skin is not connected or gone.
        """
        if not 0 < count <= (self._queue.maxlen or 0):
            raise ValueError(f"{count} samples were asked for; the queue holds 1 to {self._queue.maxlen}")
        called = time.monotonic()
        with self._changed:
            newest, rate = (self._queue[-1].number if self._queue else -1), self._rate() or self._features.rate
            timeout = 2 * count / min(rate, self._features.rate) + READ_SPARE_S if timeout is None else timeout

            def fresh() -> list[StreamRow]:
                return [row for row in self._after(newest) if row.time > called][:count]

            self._changed.wait_for(lambda: self._failure is not None or len(fresh()) == count, timeout)
            got = fresh()
            if len(got) == count:
                return self._samples(got)
            self._check()
            raise DeviceTimeoutError(
                f"{self._name} gave {len(got)} of {count} samples in {timeout:.2g} s; check its cable and its rate"
            )

    def since(self, number: SupportsIndex) -> Samples:
        """Samples after a given one that are still in the queue, without waiting, as in `Skin.since`.

        Raises:
            DeviceError: The skin is not connected or gone, and there are none.
        """
        with self._changed:
            mark = int(number)
            got = self._after(mark)
            if not got:
                self._check()
                return self._samples(got)
            if mark >= 0:
                gone = max(0, got[0].number - max(mark, self._newest_given) - 1)
                self._counters = self._counters._replace(overflowed=self._counters.overflowed + gone)
            self._newest_given = max(self._newest_given, got[-1].number)
            return self._samples(got)

    def record(self, path: str | Path) -> None:
        """Write every byte that comes from now on to a file (`i2t.hardware.reskin.recording`), until `stop_recording`
        or `close`. A full disk ends the skin as an unplugged cable would.

        Args:
            path: Of the new file.

        Raises:
            DeviceError: It exists, or cannot be written.
        """
        self._check()
        self.stop_recording()
        try:
            self._file = recording.create(path)
        except FileExistsError:
            raise DeviceError(f"{path} exists already; give the recording a new name") from None
        except OSError as error:
            raise DeviceError(f"{path} cannot be written ({error.strerror}); give another place") from error

    def stop_recording(self) -> None:
        """End the recording, if there is one."""
        file, self._file = self._file, None
        if file is not None:
            file.close()

    # The thread, and what it shares with the calls above.

    def _check(self) -> None:
        if self._failure is not None:
            raise type(self._failure)(*self._failure.args) from self._failure.__cause__

    def _after(self, number: int) -> list[StreamRow]:
        rows = list(takewhile(lambda row: row.number > number, reversed(self._queue)))
        return rows[::-1]

    @abstractmethod
    def _open(self) -> tuple[Port, Decoder, list[Frame], BoardInfo]:
        """A port from which frames come."""

    @abstractmethod
    def _lost(self, error: Exception) -> DeviceError:
        """Error that the end of a port means."""

    def _read_loop(self, port: Port, stop: threading.Event) -> None:
        try:
            while not stop.is_set():
                chunk = port.read(max(1, port.in_waiting))
                self._listened = time.monotonic()
                if chunk:
                    self._process(chunk, self._listened)
        except DeviceError as error:
            self._fail(error)
        except Exception as error:  # pyserial raises OSError, SerialException, TypeError and more
            self._fail(self._lost(error))
        finally:
            port.close()

    def _process(self, chunk: bytes, now: float) -> None:
        file = self._file
        if file is not None:
            try:
                recording.append(file, now, chunk)
            except (OSError, ValueError) as error:
                if self._file is file:  # not closed meanwhile
                    sentence = f"recording {self._name} to {file.name} failed ({error}); free some space"
                    raise DeviceError(sentence) from error
        decoder, found = frames.decode(self._decoder, chunk)
        with self._changed:
            late = len(chunk) >= PORT_BUFFER_BYTES
            self._counters = self._counters._replace(stalls=self._counters.stalls + late)
            self._accept(decoder, found, now)

    def _accept(self, decoder: Decoder, found: list[Frame], now: float) -> None:
        self._decoder = decoder
        if not found:
            return
        number = self._counters.samples + decoder.samples - len(found)
        self._arrivals.append((now, number + len(found)))
        while now - self._arrivals[0][0] > RATE_WINDOW_S:
            self._arrivals.popleft()
        per_byte = decoder.samples / decoder.taken / (self._rate() or self._features.rate)  # s
        before = self._queue[-1].time if self._queue else -np.inf
        for frame in found:
            before = max(before, now - (decoder.bytes - frame.end) * per_byte)
            self._queue.append(StreamRow(number, before, frame.reading, frame.temperature))
            number += 1
        self._changed.notify_all()

    def _total(self) -> SkinCounters:
        before, now = self._counters, self._decoder
        return before._replace(**{name: getattr(before, name) + getattr(now, name) for name in DECODER_COUNTS})

    def _rate(self) -> float:
        if len(self._arrivals) < 2 or time.monotonic() - self._arrivals[-1][0] > RATE_WINDOW_S:
            return 0.0
        (start, first), (end, last) = self._arrivals[0], self._arrivals[-1]
        return (last - first) / (end - start) if end - start > 0.2 else 0.0

    def _silence(self, age: float) -> str:
        if time.monotonic() - self._listened > age / 2:  # most of that time, so the board cannot be blamed
            return f"this computer was too busy to listen to {self._name} for {age:.2g} s; end other programs"
        if self._decoder.empty > self._decoder.samples:
            return (
                f"{self._name} has sent no value for {age:.2g} s, only frames without any chip; check the cable "
                "between board and chips, and whether the sketch reads faster than they measure"
            )
        if self._decoder.gap > 3 * self._decoder.layout.size:
            return f"{self._name} has sent no frame for {age:.2g} s, only bytes that are none; check its cable"
        return f"{self._name} has been silent for {age:.2g} s; check its cable and that its sketch runs"

    def _fail(self, error: DeviceError) -> None:
        with self._changed:
            self._failure = self._failure or error
            self._changed.notify_all()

    @property
    def _name(self) -> str:
        return self._features.name

    def _samples(self, rows: list[StreamRow]) -> Samples:
        n = len(rows)
        return Samples(
            np.array([row.number for row in rows], np.int64),
            np.array([row.time for row in rows], np.float64),
            np.array([row.reading for row in rows], np.float64).reshape(n, 3 * self._chips),
            np.array([row.temperature for row in rows], np.float64).reshape(n, self._chips),
        )


def detect_format(
    port: Port, limits: FrameLimits, chips: int, lost: Callable[[Exception], DeviceError]
) -> tuple[Decoder, list[Frame], bytes]:
    """Read from a port until one of the formats gives a frame.

    Args:
        port: Where a board's bytes come from.
        limits: What can be true of a frame.
        chips: How many the board has.
        lost: The error to raise when reading fails.

    Returns:
        The decoder that fits, its first frames, and the last bytes that came; no frames if none fits in time.

    Raises:
        DeviceError: `lost` of what went wrong.
    """
    candidates, heard, received = frames.decoders(limits, chips), b"", 0
    end = slow_end = time.monotonic() + FIRST_BYTE_S
    while time.monotonic() < end or (0 < received < PORT_BUFFER_BYTES and time.monotonic() < slow_end):
        try:
            chunk = port.read(max(1, port.in_waiting))
        except EOFError:
            break
        except Exception as error:
            raise lost(error) from error
        if chunk and not heard:
            end, slow_end = time.monotonic() + FIRST_FRAME_S, time.monotonic() + SLOW_FRAMES_S
        received += len(chunk)
        heard = (heard + chunk)[-PORT_BUFFER_BYTES:]
        candidates, found = frames.decode_any(candidates, chunk)
        if found:
            return candidates[0], found, heard
    return candidates[0], [], heard
