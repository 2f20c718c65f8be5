"""ReSkin, AnySkin and eFlesh boards on a serial port, and recordings of them.

`python -m i2t.hardware.reskin` shows one.

with ReSkin("/dev/ttyACM0") as skin:
    ambient = skin.read(10).reading.mean(axis=0)
"""

import errno
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from i2t.errors import DataError, DeviceError, DeviceTimeoutError
from i2t.hardware.reskin import frames, recording
from i2t.hardware.reskin.frames import Decoder, Frame, FrameLimits
from i2t.hardware.reskin.layouts import DEFAULT_CHIPS, Format, FrameLayout
from i2t.hardware.reskin.stream import START_UP_S, BoardInfo, Port, Stream, detect_format

RATE_HZ = 400.0  # published
BAUD_RATES = (115200, 921600, 460800, 230400, 57600, 9600)  # tried in this order; over USB any will do
VENDORS = {
    0x239A: "Adafruit",
    0x1B4F: "SparkFun",
    0x2341: "Arduino",
    0x2886: "Seeed",
}  # of boards that run the firmware
READ_TIMEOUT_S = 0.05


class ReSkin(Stream):
    """A board on a serial port (`i2t.hardware.protocols.Skin`).

    Args:
        port: Its name; by default the one board that `connect` finds.
        baud: Its rate; by default `connect` tries the usual ones.
        chips: How many magnetometers the board has.
        rate: Hz, nominal.
        limits: What can be true of a frame.
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
        limits: FrameLimits | None = None,
        capacity: int = 4096,
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
        super().__init__(name, _source(port), chips=chips, rate=rate, limits=limits, capacity=capacity)

    def ports(self) -> list[BoardInfo]:
        """USB serial ports of this machine, those of likely boards first; nothing is opened."""
        found = [port for port in self._comports() if port.vid is not None]
        return [_board_info(port) for port in sorted(found, key=lambda port: port.vid not in VENDORS)]

    def _open(self) -> tuple[Port, Decoder, list[Frame], BoardInfo]:
        port = self._find()
        rates = (self._baud,) if self._baud else BAUD_RATES
        line = self._open_port(port, rates[0])
        try:
            baud, decoder, found, heard = self._listen(line, rates)
        except BaseException:
            line.close()
            raise
        if found:
            self._features = self._features._replace(source=_source(port))
            known = {board.port: board for board in self.ports()}
            info = known.get(os.path.realpath(port), BoardInfo(port, None, decoder.layout.form))
            return line, decoder, found, info._replace(port=port, baud=baud, form=decoder.layout.form)
        line.close()
        tried = f" at {self._baud} baud" if self._baud else " at any usual baud rate" if heard else ""
        kind = DeviceError if heard else DeviceTimeoutError
        raise kind(f"no skin on {port}{tried}: {frames.diagnose(heard, self._limits, self._chips)}")

    def _listen(self, line: Port, rates: Sequence[int]) -> tuple[int, Decoder, list[Frame], bytes]:
        """The rate at which frames come, with what `detect_format` gives.

        The port stays open meanwhile: opening it resets many boards, which then send rubbish for seconds. So all rates
        are tried again until that is over.
        """
        end, current = time.monotonic() + START_UP_S, rates[0]
        while True:
            for baud in rates:
                if baud != current:
                    self._set_rate(line, baud)
                    current = baud
                decoder, found, heard = detect_format(line, self._limits, self._chips, self._lost)
                if found or not heard:  # at a wrong rate bytes are wrong, but they come
                    return baud, decoder, found, heard
            if time.monotonic() > end or frames.known_trouble(heard, self._limits, self._chips):
                return baud, decoder, found, heard

    def _set_rate(self, line: Port, baud: int) -> None:
        try:
            line.baudrate = baud
            line.reset_input_buffer()
        except ValueError as error:
            raise DeviceError(f"the skin's port cannot be set to {baud} baud; give the rate with --baud") from error
        except OSError as error:
            raise self._lost(error) from error

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
            return line
        except ValueError as error:
            raise DeviceError(f"{port} cannot be set to {baud} baud; give another rate") from error
        except OSError as error:
            raise DeviceError(self._why_closed(port, error)) from error

    def _why_closed(self, port: str, error: OSError) -> str:
        """Sentence on a port that cannot be opened."""
        code, said = error.errno, str(error)
        if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "FileNotFoundError" in said:
            names = ", ".join(board.port for board in self.ports()) or "none"
            return f"there is no port {port} (USB serial ports here: {names}); plug the skin in or name its port"
        if code == errno.EACCES or "PermissionError" in said:
            return f"{port} may not be opened; add yourself to its group (often dialout) and log in again"
        if "exclusively lock" in said or code in (errno.EBUSY, errno.EAGAIN):
            return f"{port} is in use by another program; close that one"
        return f"{port} cannot be opened ({error}); is it a serial port?"

    def _lost(self, error: Exception) -> DeviceError:
        port = self._info.port if self._info else self._asked_port
        lost = DeviceError(f"the skin on {port} is gone ({error}); plug it in and connect again")
        lost.__cause__ = error
        return lost


class Replay(Stream):
    """A recording as a skin; it fails when it is over.

    Args:
        path: Of the recording (`i2t.hardware.reskin.recording`), or of a board's bare bytes.
        speed: How many times as fast as it was.
        chips: How many magnetometers the board has.
        rate: Hz, nominal; bare bytes come at this rate.
        limits: What can be true of a frame.
        capacity: Samples that the queue holds.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        speed: float = 1.0,
        chips: int = DEFAULT_CHIPS,
        rate: float = RATE_HZ,
        limits: FrameLimits | None = None,
        capacity: int = 4096,
    ) -> None:
        self._path, self._speed = Path(path), speed
        self._byte_rate = rate * FrameLayout(chips=chips).size  # 1/s
        name = f"the recording {path}"
        super().__init__(name, "replay", chips=chips, rate=rate * speed, limits=limits, capacity=capacity)

    def _open(self) -> tuple[Port, Decoder, list[Frame], BoardInfo]:
        try:
            port = recording.PlayedPort(self._path, self._speed, self._byte_rate, READ_TIMEOUT_S)
        except OSError as error:
            raise DeviceError(f"{self._path} cannot be read ({error.strerror}); name a recording") from error
        except DataError as error:
            raise DeviceError(str(error)) from error
        decoder, found, heard = detect_format(port, self._limits, self._chips, self._lost)
        if not found:
            raise DeviceError(f"no skin in {self._path}: {frames.diagnose(heard, self._limits, self._chips)}")
        return port, decoder, found, BoardInfo(str(self._path), None, decoder.layout.form, "recording")

    def _lost(self, error: Exception) -> DeviceError:
        if isinstance(error, EOFError):
            return DeviceError(f"{self._name} is over; connect again to play it from its start")
        return DeviceError(f"{self._name} failed ({error})")


def _source(port: str | None) -> str:
    """Source of the readings: boards are not on pseudo-terminals."""
    return "emulated" if port and os.path.realpath(port).startswith(("/dev/pts/", "/dev/ttys0")) else "real"


def _board_info(port: Any) -> BoardInfo:
    maker = f"{VENDORS[port.vid]} " if port.vid in VENDORS and VENDORS[port.vid] not in (port.description or "") else ""
    usb = f"{port.vid:04x}:{port.pid:04x}"
    return BoardInfo(
        port=port.device,
        baud=None,
        form=Format.BINARY,
        description=f"{maker}{port.description}",
        serial_number=port.serial_number,
        usb=usb,
    )
