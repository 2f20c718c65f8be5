"""An emulated ReSkin, AnySkin or eFlesh board: a pseudo-terminal that sends the board's frames, with or without faults.

    python -m i2t.emulators.reskin_board --link /tmp/skin
    i2t skin --port /tmp/skin

The first line of output is the port's path (the link, if there is one). With `--field`, the second line is the address
for fields. Like a real board, it waits until the port is opened. At rest, it sends a uniform ambient field in the
axes of its chips (`i2t.skin.boards`), with noise and steps as measured on real boards. Presses can be added. Times of
faults count from when the port is first opened. The emulator runs on Linux and macOS, without JAX.
"""

import errno
import os
import select
import signal
import socket
import struct
import sys
import termios
import time
import tty
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float

from i2t.cli.exit_codes import exit_code_of
from i2t.cli.options import read_options
from i2t.cli.signals import ended_by_ctrl_c
from i2t.emulators import processes
from i2t.hardware.reskin.layouts import Format, encode
from i2t.skin.boards import make_board
from i2t.types import Board

run_board = partial(processes.run_emulator, "i2t.emulators.reskin_board")  # takes options; yields port and process


@dataclass(frozen=True)
class BoardSignal:
    """Ambient field, noise, converter steps and change by a press (uT) of an emulated board, and its temperatures.

    Temperatures are in degrees Celsius. Noise and steps are as measured on real ReSkin boards.
    """

    ambient: tuple[float, float, float] = (18.0, -7.0, -41.0)  # uT, ambient field in tool axes, about the Earth's field
    noise: tuple[float, float, float] = (3.1, 3.1, 4.6)  # uT, standard deviation of a sample of x, y and z
    steps: tuple[float, float, float] = (0.150, 0.150, 0.242)  # uT, step of the converter along x, y and z
    temperature: float = 24.6  # degrees Celsius, mean temperature of the chips
    temperature_noise: float = 0.1
    temperature_step: float = 1 / 45.2
    temperature_origin: float = 25.0  # degrees Celsius, temperature at which the converter counts 0
    press: tuple[tuple[float, float, float], ...] = ((9, 4, -38), (-14, 8, 12), (6, 20, 9), (-5, -16, 7), (11, -9, 13))
    """Change (uT) of a press on successive chips, repeated on larger boards."""
    press_period: float = 4.0  # s, time from one press to the next


@dataclass(frozen=True)
class EmulatedBoardArgs:
    """Emulate a ReSkin, AnySkin or eFlesh board on a pseudo-terminal, with faults on demand."""

    link: Path | None = None  # symbolic link to the port, created at the start and removed at the end
    board: str = "reskin"  # board to emulate: reskin, anyskin, or grid-RxC for R rows and C columns of chips
    # format of the frames, which depends on the board's firmware
    format: tyro.conf.EnumChoicesFromValues[Format] = Format.BINARY
    rate: float = 400.0  # frame rate (frames per second)
    noise: float = 1.0  # noise as a multiple of that of real boards; 0 repeats the same values exactly
    press: float = 0.0  # size of a press every 4 s, in units of 57 uT (norm on 5 chips)
    field: bool = False  # receive the field (3 float32 per chip, little-endian, uT) in UDP datagrams
    fail: tuple[int, ...] = ()  # numbers of the chips that stop answering
    fail_after: float = 0.0  # time (s) until the chips in --fail stop answering
    freeze_after: float = float("inf")  # time (s) until the board begins to repeat the same values
    fail_share: float = 0.0  # fraction of the samples in which a chip does not answer, independently for each chip
    # only every Nth frame holds values, as if the firmware read faster than the chips measure; 1 fills all frames
    empty: int = 1
    skip: float = 0.0  # fraction of the frames that are lost
    garbage_for: float = 0.0  # duration (s) of random bytes each time that the port is opened, which resets the board
    silent_after: float = float("inf")  # time (s) until the board stops sending
    silent_for: float = float("inf")  # duration (s) of the pause after --silent-after
    unplug_after: float = float("inf")  # time (s) until the board is unplugged
    replug_after: float = float("inf")  # time (s) until the board is plugged in again, under the same link
    baud: int | None = None  # baud rate of an emulated UART; a client at any other rate receives random bytes
    seed: int = 0  # seed of the noise and of the random faults
    tethered: bool = False  # exit when standard input closes, so that the board ends with the program that started it


class Readings:
    """Random readings of an emulated board's chips, with noise, temperature and periodic presses.

    Args:
        noise: Noise relative to that of real boards.
        press: Size of the periodic presses, as a multiple of `BoardSignal.press`; 0 for none.
        seed: Seed of the noise.
        board: Board of the chips; by default ReSkin's.
        signal: Fields, noise and steps of the board.
    """

    def __init__(
        self, noise: float, press: float, seed: int, board: Board | None = None, *, signal: BoardSignal = BoardSignal()
    ) -> None:
        board = make_board("reskin") if board is None else board
        self.chips = len(board.chips)
        self._rng = np.random.default_rng(seed)
        self._press = press * np.resize(signal.press, (self.chips, 3)).ravel()
        self._noise, self._signal = noise, signal
        # uT, without noise and press; may be replaced
        self.field = np.asarray(board.to_board(np.tile(signal.ambient, (self.chips, 1))))

    def at(self, now: float) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " chips"]]:
        """Draw one sample of all chips.

        Args:
            now: Time (s) since the board was opened.

        Returns:
            The reading (uT, 3 values for each chip) and the chips' temperatures (degrees Celsius).
        """
        signal = self._signal
        pressed = max(0.0, np.sin(2 * np.pi * now / signal.press_period)) ** 2
        noise = self._noise * np.tile(signal.noise, self.chips) * self._rng.standard_normal(3 * self.chips)
        steps = np.tile(signal.steps, self.chips)
        counts = np.round((self.field + pressed * self._press + noise) / steps)
        counts = (counts + 2**15) % 2**16 - 2**15  # a converter of 16 bits wraps around
        warmth = signal.temperature + self._noise * signal.temperature_noise * self._rng.standard_normal(self.chips)
        celsius = np.round((warmth - signal.temperature_origin) / signal.temperature_step)
        return counts * steps, signal.temperature_origin + celsius * signal.temperature_step


class BoardPort:
    """An emulated board's end of a pseudo-terminal, which stands for a serial port and may be unplugged.

    Args:
        link: Symbolic link to create to the end that a driver opens; None for no link.
    """

    def __init__(self, link: Path | None) -> None:
        self._link = link
        self.master: int | None = None

    @property
    def plugged(self) -> bool:
        """Whether the port exists: plugged in and not unplugged since."""
        return self.master is not None

    def plug(self) -> str:
        """Create the port and its link, and return the path that a driver opens."""
        self.master, slave = os.openpty()
        tty.setraw(slave)
        port = os.ttyname(slave)
        os.close(slave)  # so that the port shows whether somebody else has it open
        os.set_blocking(self.master, False)
        if self._link is None:
            return port
        self._unlink()
        self._link.symlink_to(port)
        return str(self._link)

    def unplug(self) -> None:
        """Remove the port, even while it is open."""
        if self.master is not None:
            os.close(self.master)
            self.master = None
        self._unlink()

    def is_open(self) -> bool:
        """Test whether a program has the port open."""
        if self.master is None:
            return False
        poll = select.poll()
        poll.register(self.master, select.POLLIN)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    def baud_rate(self) -> int:
        """Read the baud rate to which the port is set; 0 if it is unknown."""
        assert self.master is not None
        code = termios.tcgetattr(self.master)[4]
        names = (name for name in dir(termios) if name[0] == "B" and name[1:].isdigit())
        return next((int(name[1:]) for name in names if getattr(termios, name) == code), 0)

    def send(self, chunk: bytes) -> None:
        """Send bytes to the driver. Those that do not fit the buffer are lost, and so are bytes sent to the board.

        Args:
            chunk: Bytes to send.

        Raises:
            OSError: If the port is gone.
        """
        assert self.master is not None
        try:
            os.write(self.master, chunk)
            while os.read(self.master, 4096):
                pass
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EIO):
                raise

    def _unlink(self) -> None:
        if self._link is not None and self._link.is_symlink():
            self._link.unlink()


def main(args: Sequence[str] | None = None) -> int:
    """Run the emulated board's command line until SIGTERM or Ctrl-C.

    Args:
        args: Arguments without the program's name; by default, those of `sys.argv`.

    Returns:
        The exit code of the process.
    """
    options = read_options(EmulatedBoardArgs, args, program="python -m i2t.emulators.reskin_board", description=__doc__)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))

    def work() -> None:
        board = make_board(options.board)
        if options.link and options.link.exists() and not options.link.is_symlink():
            raise ValueError(f"--link {options.link}: exists and is not a link; give another name")
        if options.empty < 1 or any(not 0 <= chip < board.num_chips for chip in options.fail):
            raise ValueError(f"--fail takes chips 0 to {board.num_chips - 1}, --empty takes 1 or more; correct them")
        port = BoardPort(options.link)
        try:
            with ended_by_ctrl_c():
                print(port.plug(), flush=True)
                _serve(port, board, options)
        finally:
            port.unplug()

    return exit_code_of(work)


def _serve(port: BoardPort, board: Board, options: EmulatedBoardArgs) -> None:
    readings = Readings(options.noise, options.press, options.seed, board)
    line = _Line(options)
    inbox = _field_inbox() if options.field else None
    opened: float | None = None  # when the port was first opened
    reset = -np.inf  # when the port was opened last
    due = time.monotonic()
    while not (options.tethered and processes.has_ended(sys.stdin)):
        now = time.monotonic()
        elapsed = -1.0 if opened is None else now - opened
        if inbox is not None:
            readings.field = _newest_field(inbox, readings.field)
        unplugged = options.unplug_after <= elapsed < options.replug_after
        if unplugged and port.plugged:
            port.unplug()
        elif not unplugged and not port.plugged:
            port.plug()
        if unplugged or not port.is_open():
            time.sleep(0.01)
            due, reset = time.monotonic(), np.inf
            continue
        opened = now if opened is None else opened
        reset = min(reset, now)
        if now - reset < options.garbage_for:
            port.send(line.start_up_bytes())
        elif not options.silent_after <= elapsed < options.silent_after + options.silent_for:
            port.send(line.frame(*readings.at(max(0.0, elapsed)), port, elapsed))
        due += 1 / options.rate
        time.sleep(max(0.0, due - time.monotonic()))


class _Line:
    """Output of the board, which may lose samples."""

    def __init__(self, options: EmulatedBoardArgs) -> None:
        self._options, self._count = options, -1
        self._rng = np.random.default_rng((options.seed, 1))  # random bytes
        self._faults = np.random.default_rng((options.seed, 2))  # faults of chips and whole frames

    def frame(self, reading: np.ndarray, temperature: np.ndarray, port: BoardPort, elapsed: float) -> bytes:
        """Encode a sample as the board sends it, or as a wrong baud rate changes it. Faults depend on `elapsed` (s)."""
        options = self._options
        self._count += 1
        if not self._count or elapsed < options.freeze_after:
            self._values = reading, temperature
        reading, temperature = self._values
        missing = self._faults.random(len(temperature)) < options.fail_share
        missing[list(options.fail if elapsed >= options.fail_after else ())] = True
        missing |= self._count % options.empty != 0
        frame = encode(np.where(np.repeat(missing, 3), 0.0, reading), temperature, options.format, self._count)
        if self._faults.random() < options.skip:
            return b""
        if options.baud and port.baud_rate() != options.baud:
            frame = self._rng.bytes(len(frame))
        return frame

    def start_up_bytes(self) -> bytes:
        """Draw bytes that a board sends while it starts."""
        return self._rng.bytes(60)


def _field_inbox() -> socket.socket:
    inbox = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    inbox.bind(("127.0.0.1", 0))
    inbox.setblocking(False)
    print("field {}:{}".format(*inbox.getsockname()), flush=True)
    return inbox


def _newest_field(inbox: socket.socket, field: np.ndarray) -> np.ndarray:
    """Return the newest field that was sent, or the old one.

    A field of another board ends the program, and with it the press: a skin that shows nothing would be pressed on and
    on.
    """
    try:
        while True:
            data = inbox.recv(4096)
            if len(data) != 4 * len(field):
                sys.exit(
                    f"error: a field has {len(data) / 4:g} values, and this board {len(field)}; name the same --board"
                )
            field = np.array(struct.unpack(f"<{len(field)}f", data))
    except BlockingIOError:
        return field


if __name__ == "__main__":
    sys.exit(main())
