"""ReSkin, AnySkin and eFlesh boards on a serial port.

`i2t skin` shows the readings of a board.

with ReSkin("/dev/ttyACM0") as skin:
    ambient = skin.read(10).reading.mean(axis=0)

A thread (`i2t.hardware.skin_stream`) decodes bytes into frames (`i2t.hardware.reskin.frames`). A sample's time is that
of the read that returned its last byte, minus the time that the later bytes of the same read took at the board's rate.
"""

import errno
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from i2t.errors import DeviceError, DeviceTimeoutError, MissingDriverError, NotConnectedError
from i2t.hardware.protocols import SkinCounters
from i2t.hardware.reskin import frames
from i2t.hardware.reskin.frames import Decoder, Frame
from i2t.hardware.reskin.layouts import DEFAULT_CHIPS, Format
from i2t.hardware.serial_port import COMMON_PORT_USERS, explain_no_access, other_users, set_exclusive, users_of
from i2t.hardware.skin_stream import Measurement, StreamConfig, StreamedSkin
from i2t.installation import extra_advice

# Vendors, by USB vendor number, of boards that run the skin's firmware.
VENDORS = {0x239A: "Adafruit", 0x1B4F: "SparkFun", 0x2341: "Arduino", 0x2886: "Seeed"}
CLOSE_PROGRAM = "close that program and connect again"  # remedy if another program uses the serial port of the skin


@dataclass(frozen=True)
class BoardSearch:
    """Baud rates that are tried, and timeouts (s), to detect the baud rate and the frame format of a board."""

    # baud rates to try, in this order; over USB any works
    baud_rates: tuple[int, ...] = (115200, 921600, 460800, 230400, 57600, 9600)
    read_timeout: float = 0.05
    judged_bytes: int = 4000  # number of newest bytes by which a board without frames is diagnosed
    first_byte_timeout: float = 3.0  # s, waiting time for a byte after the port is opened
    first_frame_timeout: float = 1.5  # s, waiting time for a frame after the first byte
    startup_time: float = 6.0  # s, duration of invalid bytes after a reset, which opening the port may cause


class BoardInfo(NamedTuple):
    """Port, baud rate, frame format, and USB description, serial number and ids of a skin's board."""

    port: str
    baud: int | None
    form: Format
    description: str = ""  # USB description
    serial_number: str | None = None
    usb: str | None = None  # USB vendor and product numbers


class ReSkin(StreamedSkin):
    """Driver of a ReSkin, AnySkin or eFlesh board on a serial port (`i2t.hardware.protocols.Skin`).

    Args:
        port: Name of the port; by default the only board that `connect` finds.
        baud: Baud rate of the port; by default `connect` tries the usual ones.
        chips: Number of magnetometers of the board.
        rate: Nominal rate in Hz; by default the published one.
        capacity: Number of samples that the queue holds.
        serial_number: Serial number of the board, instead of its port.
        search: Rates and timeouts with which baud rate and frame format are detected.

    Raises:
        DeviceError: pyserial is missing.
    """

    def __init__(
        self,
        port: str | None = None,
        baud: int | None = None,
        *,
        chips: int = DEFAULT_CHIPS,
        rate: float = 400.0,
        capacity: int = StreamConfig.queue_samples,
        serial_number: str | None = None,
        search: BoardSearch = BoardSearch(),
    ) -> None:
        try:
            import serial
            from serial.tools import list_ports
        except ImportError as error:
            raise MissingDriverError(f"the skin needs pyserial: {extra_advice('hardware', 'pyserial')}") from error
        self._serial, self._comports = serial.Serial, list_ports.comports
        self._requested_port, self._requested_serial, self._baud = port, serial_number, baud
        self._search = search
        name = f"the skin on {port}" if port else f"the skin {serial_number}" if serial_number else "the skin"
        super().__init__(name, chips, rate, source=_source(port), capacity=capacity)
        self._chips, self._decoder, self._counters = chips, Decoder(), SkinCounters()  # of earlier connections
        self._first_frames: list[Frame] = []  # frames of the bytes that revealed the format
        self._newest_time = -np.inf  # s, of the newest sample
        self._listened = -np.inf  # s, when the thread last returned from the port
        self._info: BoardInfo | None = None

    @property
    def info(self) -> BoardInfo:
        """Port, baud rate, frame format and USB names; raises NotConnectedError before the first connection."""
        if self._info is None:
            raise NotConnectedError(f"{self._name} has not been connected yet, so its board is unknown")
        return self._info

    @property
    def counters(self) -> SkinCounters:
        """Counts of samples, bytes and losses since the first connection."""
        with self._lock:
            return self._total()._replace(connects=self._connects, rate=self._rate())

    def open_link(self) -> Any:
        """Open the board's port and detect the format of its frames.

        Returns:
            The open port.

        Raises:
            DeviceError: The board was not found, or does not send frames.
        """
        port, decoder, self._first_frames, self._info = self._open()
        with self._lock:
            self._counters, self._decoder = self._total(), decoder
        return port

    def receive(self, link: Any) -> list[Measurement]:
        """Receive the samples in the frames that have arrived whole, as in `StreamedSkin.receive`."""
        new_frames, self._first_frames = self._first_frames, []
        if not new_frames:
            chunk = link.read(max(1, link.in_waiting))
            self._listened = time.monotonic()
            decoder, new_frames = frames.decode(self._decoder, chunk)
            with self._lock:
                self._decoder = decoder
        decoder, now = self._decoder, time.monotonic()
        per_byte = decoder.samples / max(1, decoder.taken) / (self._rate(len(new_frames)) or self._features.rate)  # s
        measured = []
        for frame in new_frames:
            self._newest_time = max(self._newest_time, now - (decoder.bytes - frame.end) * per_byte)
            measured.append(Measurement(self._newest_time, frame.reading, frame.temperature))
        return measured

    def close_link(self, link: Any) -> None:
        """Close the port of the board, as in `StreamedSkin.close_link`."""
        set_exclusive(link, False)
        link.close()

    def _total(self) -> SkinCounters:
        before, now = self._counters, self._decoder
        names = ("samples", "lost", "gaps", "skipped", "empty", "missing", "bytes")
        return before._replace(**{name: getattr(before, name) + getattr(now, name) for name in names})

    def _silence_message(self, age: float) -> str:
        if time.monotonic() - self._listened > age / 2:  # for most of that time, so the board is not to blame
            return f"this computer was too busy to listen to {self._name} for {age:.2g} s; end other programs"
        if others := other_users(self._port):
            return f"{self._name} has delivered no frame for {age:.2g} s: {others} reads its port too; {CLOSE_PROGRAM}"
        if self._decoder.empty > self._decoder.samples:
            return (
                f"{self._name} has sent no value for {age:.2g} s, only frames without any chip; check the cable "
                "between board and chips, and whether the sketch reads faster than the chips measure"
            )
        if self._decoder.gap > 3 * self._decoder.layout.size:
            return f"{self._name} has sent no frame for {age:.2g} s, only bytes that form no frame; check its cable"
        return f"{self._name} has been silent for {age:.2g} s; check its cable and that its sketch runs"

    # The board and its port

    def ports(self) -> list[BoardInfo]:
        """List the USB serial ports of this machine, likely boards first; baud rate and format are not detected."""
        ports = [port for port in self._comports() if port.vid is not None]
        return [_board_info(port) for port in sorted(ports, key=lambda port: port.vid not in VENDORS)]

    def _open(self) -> tuple[Any, Decoder, list[Frame], BoardInfo]:
        port = self._find()
        rates = (self._baud,) if self._baud else self._search.baud_rates
        line = self._open_port(port, rates[0])
        try:
            baud, decoder, first_frames, received = self._listen(line, rates)
        except BaseException:
            self.close_link(line)
            raise
        if first_frames:
            self._features = self._features._replace(source=_source(port))
            boards = {board.port: board for board in self.ports()}
            info = boards.get(os.path.realpath(port), BoardInfo(port, None, decoder.layout.form))
            return line, decoder, first_frames, info._replace(port=port, baud=baud, form=decoder.layout.form)
        self.close_link(line)
        kind = DeviceError if received else DeviceTimeoutError
        raise kind(f"no skin on {port}: {diagnose(received, self._chips, self._baud)}")

    def _listen(self, line: Any, rates: Sequence[int]) -> tuple[int, Decoder, list[Frame], bytes]:
        """Find the rate at which frames arrive; return it with the results of `_detect`.

        The port stays open meanwhile: opening it resets many boards, which then send invalid bytes for seconds. So all
        rates are tried again until that time is over.
        """
        end, current = time.monotonic() + self._search.startup_time, rates[0]
        while True:
            for baud in rates:
                try:
                    if baud != current:
                        line.baudrate = current = baud
                        line.reset_input_buffer()
                except ValueError as error:
                    raise DeviceError(f"the port cannot be set to {baud} baud; give its rate with --baud") from error
                except OSError as error:
                    raise self._lost_error(error) from error
                decoder, first_frames, received = self._detect(line)
                if first_frames or not received:  # a wrong rate garbles bytes, but does not suppress them
                    return baud, decoder, first_frames, received
            if time.monotonic() > end or frames.recognised_problem(received, self._chips):
                return baud, decoder, first_frames, received

    def _detect(self, line: Any) -> tuple[Decoder, list[Frame], bytes]:
        """Find the format: the matching decoder, its first frames (if any in time), and the newest bytes."""
        candidates, received = frames.decoders(self._chips), b""
        end = time.monotonic() + self._search.first_byte_timeout
        while time.monotonic() < end:
            try:
                chunk = line.read(max(1, line.in_waiting))
            except Exception as error:
                raise self._lost_error(error) from error
            end = time.monotonic() + self._search.first_frame_timeout if chunk and not received else end
            received = (received + chunk)[-self._search.judged_bytes :]
            candidates, first_frames = frames.decode_any(candidates, chunk)
            if first_frames:
                return candidates[0], first_frames, received
        return candidates[0], [], received

    def _find(self) -> str:
        """Return the requested port, or that of the previous board, or that of the only likely board."""
        before = self._requested_serial or (self._info.serial_number if self._info else None)
        if self._requested_port is not None and (before is None or os.path.exists(self._requested_port)):
            return self._requested_port
        boards = self.ports()
        choices = [[board for board in boards if before is not None and board.serial_number == before]]
        if self._requested_serial and not choices[0]:
            there = ", ".join(f"{board.serial_number or 'unnumbered'} on {board.port}" for board in boards)
            raise DeviceError(
                f"no board has the serial number {self._requested_serial} (USB serial ports here: {there or 'none'}); "
                "plug it in, or correct the number"
            )
        if self._requested_port is None:
            choices += [[board for board in boards if int((board.usb or "0")[:4], 16) in VENDORS], boards]
        choice = next(filter(None, choices), [])
        if len(choice) > 1:
            names = ", ".join(f"{board.port} ({board.description})" for board in choice)
            raise DeviceError(f"more than one board may be the skin: {names}; name its port")
        if not choice and self._requested_port is None:
            raise DeviceError("no USB serial port was found; plug the skin in, or name its port")
        return choice[0].port if choice else str(self._requested_port)

    def _open_port(self, port: str, baud: int) -> Any:
        exclusive = True if os.name == "posix" else None
        try:
            line = self._serial(port, baud, timeout=self._search.read_timeout, exclusive=exclusive)
            line.reset_input_buffer()  # drop the bytes that were sent before the port was opened
        except ValueError as error:
            raise DeviceError(f"{port} cannot be set to {baud} baud; give another rate") from error
        except OSError as error:
            raise DeviceError(self._open_problem(port, error)) from error
        if others := other_users(port):
            line.close()
            raise DeviceError(
                f"{port} is also read by {others}, and each byte reaches only one program; {CLOSE_PROGRAM}"
            )
        if _source(port) == "real":  # a pseudo-terminal would stay closed if this process were killed
            set_exclusive(line)
        return line

    def _open_problem(self, port: str, error: OSError) -> str:
        """Explain why a port cannot be opened."""
        code, message = error.errno, str(error)
        if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "FileNotFoundError" in message:
            names = ", ".join(board.port for board in self.ports()) or "none"
            return f"there is no port {port} (USB serial ports here: {names}); plug the skin in or name its port"
        if code == errno.EACCES or "PermissionError" in message:
            return explain_no_access(port)
        if "exclusively lock" in message or code in (errno.EBUSY, errno.EAGAIN):
            if os.getpid() in users_of(port):
                return f"{port} is already open in this program; name each skin's own port"
            others = other_users(port) or f"another program, such as {COMMON_PORT_USERS}"
            return f"{port} is in use by {others}; {CLOSE_PROGRAM}"
        return f"{port} cannot be opened ({error}); is it a serial port with a device on it?"

    @property
    def _port(self) -> str:
        """Port that is or was open, or that was requested."""
        return self._info.port if self._info else str(self._requested_port)

    def _lost_error(self, error: BaseException) -> DeviceError:
        port, others = self._port, other_users(self._port)
        if others:
            problem = f"the skin on {port} lost bytes to {others}, which reads the port too; {CLOSE_PROGRAM}"
        elif "multiple access" in str(error) and os.path.exists(port):
            problem = (
                f"the connection to the skin on {port} broke: it was unplugged for a moment, or another program reads "
                f"the port too, such as {COMMON_PORT_USERS}; check its cable, close such programs and connect again"
            )
        else:
            problem = f"the skin on {port} is gone ({error}); plug it in and connect again"
        lost = DeviceError(problem)
        lost.__cause__ = error
        return lost


def diagnose(received: bytes, chips: int, baud: int | None = None) -> str:
    """Explain why the bytes that a board sent hold no valid frame.

    Args:
        received: Bytes that the board has sent.
        chips: Number of chips that the board should have.
        baud: Baud rate, if only one was tried.

    Returns:
        A clause with the remedy.
    """
    problem = frames.recognised_problem(received, chips)
    if problem or received.isascii():
        return problem or "the board sends lines of text; flash the sketch that sends binary frames"
    tried = f"at {baud} baud" if baud else "at any usual rate"
    return f"{len(received)} bytes arrived {tried} but form no frame; check the baud rate and the name of the port"


def _source(port: str | None) -> str:
    """Source of the readings: real boards are not on pseudo-terminals."""
    return "emulated" if port and os.path.realpath(port).startswith(("/dev/pts/", "/dev/ttys0")) else "real"


def _board_info(port: Any) -> BoardInfo:
    maker, usb = VENDORS.get(port.vid, ""), f"{port.vid:04x}:{port.pid:04x}"
    description = f"{maker} {port.description}".strip() if maker not in (port.description or "") else port.description
    return BoardInfo(port.device, None, Format.BINARY, description, port.serial_number, usb)
