"""ReSkin, AnySkin and eFlesh boards on a serial port.

`python -m i2t.hardware.reskin` shows one.

with ReSkin("/dev/ttyACM0") as skin:
    ambient = skin.read(10).reading.mean(axis=0)

Bytes become frames (`i2t.hardware.reskin.frames`) in a thread of its own (`i2t.hardware.skin_stream`). A sample's time
is that of the read that brought its last byte, less what came after it in the same read at the board's rate.
"""

import errno
import os
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from i2t.errors import DeviceError, DeviceTimeoutError, NotConnectedError
from i2t.hardware.protocols import SkinCounters
from i2t.hardware.reskin import frames
from i2t.hardware.reskin.frames import Decoder, Frame
from i2t.hardware.reskin.layouts import DEFAULT_CHIPS, Format
from i2t.hardware.serial_port import OFTEN_READ_PORTS, keep_others_out, other_users, users_of, why_forbidden
from i2t.hardware.skin_stream import QUEUE_SAMPLES, Measurement, StreamedSkin

RATE_HZ = 400.0  # published
BAUD_RATES = (115200, 921600, 460800, 230400, 57600, 9600)  # tried in this order; over USB any will do
VENDORS = {0x239A: "Adafruit", 0x1B4F: "SparkFun", 0x2341: "Arduino", 0x2886: "Seeed"}  # that run the firmware
READ_TIMEOUT_S = 0.05
HEARD_BYTES = 4000  # of the last that came, by which a board without frames is judged
FIRST_BYTE_S = 3.0  # that a board may need to start after its port is opened
FIRST_FRAME_S = 1.5  # from its first byte to its first frame
START_UP_S = 6.0  # that a board may send rubbish after it was reset, which opening its port may do
CLOSE_IT = "close that program and connect again"
DECODER_COUNTS = ("samples", "lost", "gaps", "skipped", "empty", "missing", "bytes")


class BoardInfo(NamedTuple):
    """Properties of a connected board."""

    port: str
    baud: int | None
    form: Format
    description: str = ""  # as USB tells it
    serial_number: str | None = None
    usb: str | None = None  # vendor and product


class ReSkin(StreamedSkin):
    """A board on a serial port (`i2t.hardware.protocols.Skin`).

    Args:
        port: Its name; by default the one board that `connect` finds.
        baud: Its rate; by default `connect` tries the usual ones.
        chips: How many magnetometers the board has.
        rate: Hz, nominal.
        capacity: Samples that the queue holds.
        serial_number: Of the board, which then has to be there; in place of its port.

    Raises:
        DeviceError: pyserial is missing.
    """

    def __init__(
        self,
        port: str | None = None,
        baud: int | None = None,
        *,
        chips: int = DEFAULT_CHIPS,
        rate: float = RATE_HZ,
        capacity: int = QUEUE_SAMPLES,
        serial_number: str | None = None,
    ) -> None:
        try:
            import serial
            from serial.tools import list_ports
        except ImportError as error:
            raise DeviceError("pyserial is missing; install it with: pip install 'imagine2touch[hardware]'") from error
        self._serial, self._comports = serial.Serial, list_ports.comports
        self._asked_port, self._asked_serial, self._baud = port, serial_number, baud
        name = f"the skin on {port}" if port else f"the skin {serial_number}" if serial_number else "the skin"
        super().__init__(name, chips, rate, source=_source(port), capacity=capacity)
        self._chips, self._decoder, self._counters = chips, Decoder(), SkinCounters()  # of earlier connections
        self._begun: list[Frame] = []  # frames of the board's first bytes, which told its format
        self._newest_time = -np.inf  # s, of the newest sample
        self._listened = -np.inf  # s, when the thread last came back from the port
        self._info: BoardInfo | None = None

    @property
    def info(self) -> BoardInfo:
        """Port, speed, format and USB names; raises NotConnectedError before the first connection."""
        if self._info is None:
            raise NotConnectedError(f"{self._name} has not been connected yet, so nothing is known of its board")
        return self._info

    @property
    def counters(self) -> SkinCounters:
        """Counts so far."""
        with self._lock:
            return self._total()._replace(connects=self._connects, rate=self._rate())

    def open_link(self) -> Any:
        """Open the port and find the format of its frames.

        Returns:
            The port.

        Raises:
            DeviceError: There is no such board, or it does not send frames.
        """
        port, decoder, found, self._info = self._open()
        with self._lock:
            self._counters, self._decoder = self._total(), decoder
        self._begun = found
        return port

    def receive(self, link: Any) -> list[Measurement]:
        """Samples of the frames that are whole by now, as in `StreamedSkin.receive`."""
        found, self._begun = self._begun, []
        if not found:
            chunk = link.read(max(1, link.in_waiting))
            self._listened = time.monotonic()
            decoder, found = frames.decode(self._decoder, chunk)
            with self._lock:
                self._decoder = decoder
        decoder, now = self._decoder, time.monotonic()
        per_byte = decoder.samples / max(1, decoder.taken) / (self._rate(len(found)) or self._features.rate)  # s
        measured = []
        for frame in found:
            self._newest_time = max(self._newest_time, now - (decoder.bytes - frame.end) * per_byte)
            measured.append(Measurement(self._newest_time, frame.reading, frame.temperature))
        return measured

    def close_link(self, link: Any) -> None:
        """Give the port back, as in `StreamedSkin.close_link`."""
        keep_others_out(link, False)
        link.close()

    def _total(self) -> SkinCounters:
        before, now = self._counters, self._decoder
        return before._replace(**{name: getattr(before, name) + getattr(now, name) for name in DECODER_COUNTS})

    def _silence(self, age: float) -> str:
        if time.monotonic() - self._listened > age / 2:  # most of that time, so the board cannot be blamed
            return f"this computer was too busy to listen to {self._name} for {age:.2g} s; end other programs"
        if others := other_users(self._port):
            return f"{self._name} has sent no frame for {age:.2g} s that {others} did not take away; {CLOSE_IT}"
        if self._decoder.empty > self._decoder.samples:
            return (
                f"{self._name} has sent no value for {age:.2g} s, only frames without any chip; check the cable "
                "between board and chips, and whether the sketch reads faster than they measure"
            )
        if self._decoder.gap > 3 * self._decoder.layout.size:
            return f"{self._name} has sent no frame for {age:.2g} s, only bytes that are none; check its cable"
        return f"{self._name} has been silent for {age:.2g} s; check its cable and that its sketch runs"

    # The board, and the port that it is on.

    def ports(self) -> list[BoardInfo]:
        """USB serial ports of this machine, those of likely boards first; nothing is opened."""
        found = [port for port in self._comports() if port.vid is not None]
        return [_board_info(port) for port in sorted(found, key=lambda port: port.vid not in VENDORS)]

    def _open(self) -> tuple[Any, Decoder, list[Frame], BoardInfo]:
        port = self._find()
        rates = (self._baud,) if self._baud else BAUD_RATES
        line = self._open_port(port, rates[0])
        try:
            baud, decoder, found, heard = self._listen(line, rates)
        except BaseException:
            self.close_link(line)
            raise
        if found:
            self._features = self._features._replace(source=_source(port))
            known = {board.port: board for board in self.ports()}
            info = known.get(os.path.realpath(port), BoardInfo(port, None, decoder.layout.form))
            return line, decoder, found, info._replace(port=port, baud=baud, form=decoder.layout.form)
        self.close_link(line)
        kind = DeviceError if heard else DeviceTimeoutError
        raise kind(f"no skin on {port}: {diagnose(heard, self._chips, self._baud)}")

    def _listen(self, line: Any, rates: Sequence[int]) -> tuple[int, Decoder, list[Frame], bytes]:
        """The rate at which frames come, with what `_detect` gives.

        The port stays open meanwhile: opening it resets many boards, which then send rubbish for seconds. So all rates
        are tried again until that is over.
        """
        end, current = time.monotonic() + START_UP_S, rates[0]
        while True:
            for baud in rates:
                try:
                    if baud != current:
                        line.baudrate = current = baud
                        line.reset_input_buffer()
                except ValueError as error:
                    raise DeviceError(f"the port cannot be set to {baud} baud; give its rate with --baud") from error
                except OSError as error:
                    raise self._lost(error) from error
                decoder, found, heard = self._detect(line)
                if found or not heard:  # at a wrong rate bytes are wrong, but they come
                    return baud, decoder, found, heard
            if time.monotonic() > end or frames.known_trouble(heard, self._chips):
                return baud, decoder, found, heard

    def _detect(self, line: Any) -> tuple[Decoder, list[Frame], bytes]:
        """The decoder that fits, its first frames, and the last bytes that came; no frames if none fits in time."""
        candidates, heard, end = frames.decoders(self._chips), b"", time.monotonic() + FIRST_BYTE_S
        while time.monotonic() < end:
            try:
                chunk = line.read(max(1, line.in_waiting))
            except Exception as error:
                raise self._lost(error) from error
            end = time.monotonic() + FIRST_FRAME_S if chunk and not heard else end
            heard = (heard + chunk)[-HEARD_BYTES:]
            candidates, found = frames.decode_any(candidates, chunk)
            if found:
                return candidates[0], found, heard
        return candidates[0], [], heard

    def _find(self) -> str:
        """The port that was asked for, or the board that was there before, or the only likely one."""
        before = self._asked_serial or (self._info.serial_number if self._info else None)
        if self._asked_port is not None and (before is None or os.path.exists(self._asked_port)):
            return self._asked_port
        known = self.ports()
        choices = [[board for board in known if before is not None and board.serial_number == before]]
        if self._asked_serial and not choices[0]:
            there = ", ".join(f"{board.serial_number or 'one without a number'} on {board.port}" for board in known)
            raise DeviceError(
                f"no board has the serial number {self._asked_serial} (USB serial ports here: {there or 'none'}); plug "
                "it in, or correct the number"
            )
        if self._asked_port is None:
            choices += [[board for board in known if int((board.usb or "0")[:4], 16) in VENDORS], known]
        choice = next(filter(None, choices), [])
        if len(choice) > 1:
            names = ", ".join(f"{board.port} ({board.description})" for board in choice)
            raise DeviceError(f"more than one board may be the skin: {names}; name its port")
        if not choice and self._asked_port is None:
            raise DeviceError("no USB serial port was found; plug the skin in, or name its port")
        return choice[0].port if choice else str(self._asked_port)

    def _open_port(self, port: str, baud: int) -> Any:
        try:
            line = self._serial(port, baud, timeout=READ_TIMEOUT_S, exclusive=True if os.name == "posix" else None)
            line.reset_input_buffer()  # what was sent to nobody is old
        except ValueError as error:
            raise DeviceError(f"{port} cannot be set to {baud} baud; give another rate") from error
        except OSError as error:
            raise DeviceError(self._why_closed(port, error)) from error
        if others := other_users(port):
            line.close()
            raise DeviceError(f"{port} is read by {others} too, and each byte reaches one program only; {CLOSE_IT}")
        if _source(port) == "real":  # a pseudo-terminal would stay closed if this process were killed
            keep_others_out(line)
        return line

    def _why_closed(self, port: str, error: OSError) -> str:
        """Sentence on a port that cannot be opened."""
        code, message = error.errno, str(error)
        if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "FileNotFoundError" in message:
            names = ", ".join(board.port for board in self.ports()) or "none"
            return f"there is no port {port} (USB serial ports here: {names}); plug the skin in or name its port"
        if code == errno.EACCES or "PermissionError" in message:
            return why_forbidden(port)
        if "exclusively lock" in message or code in (errno.EBUSY, errno.EAGAIN):
            if os.getpid() in users_of(port):
                return f"{port} is open already in this very program; name each skin's own port"
            others = other_users(port) or f"another program, such as {OFTEN_READ_PORTS}"
            return f"{port} is in use by {others}; {CLOSE_IT}"
        return f"{port} cannot be opened ({error}); is it a serial port with a device on it?"

    @property
    def _port(self) -> str:
        """The port that is or was open, or was asked for."""
        return self._info.port if self._info else str(self._asked_port)

    def _lost(self, error: BaseException) -> DeviceError:
        port, others = self._port, other_users(self._port)
        if others:
            problem = f"the skin on {port} lost bytes to {others}, which reads the port too; {CLOSE_IT}"
        elif "multiple access" in str(error) and os.path.exists(port):
            problem = (
                f"the skin on {port} broke off: it was unplugged for a moment, or another program reads the port too, "
                f"such as {OFTEN_READ_PORTS}; check its cable, close such programs and connect again"
            )
        else:
            problem = f"the skin on {port} is gone ({error}); plug it in and connect again"
        lost = DeviceError(problem)
        lost.__cause__ = error
        return lost


def diagnose(heard: bytes, chips: int, baud: int | None = None) -> str:
    """Explain why a board's bytes gave no frame.

    Args:
        heard: What it has sent.
        chips: How many the board is taken to have.
        baud: The only rate that was tried.

    Returns:
        Half a sentence with the remedy.
    """
    known = frames.known_trouble(heard, chips)
    if known or heard.isascii():
        return known or "lines of text come; let the board run the sketch that sends binary frames"
    tried = f"at {baud} baud" if baud else "at any usual rate"
    return f"{len(heard)} bytes came {tried} that are no frames; check the baud rate and that this port is the skin's"


def _source(port: str | None) -> str:
    """Source of the readings: boards are not on pseudo-terminals."""
    return "emulated" if port and os.path.realpath(port).startswith(("/dev/pts/", "/dev/ttys0")) else "real"


def _board_info(port: Any) -> BoardInfo:
    maker, usb = VENDORS.get(port.vid, ""), f"{port.vid:04x}:{port.pid:04x}"
    named = f"{maker} {port.description}".strip() if maker not in (port.description or "") else port.description
    return BoardInfo(port.device, None, Format.BINARY, named, port.serial_number, usb)
