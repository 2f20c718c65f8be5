"""An emulated ReSkin, AnySkin or eFlesh board: a pseudo-terminal that sends its frames, well or badly.

    python -m i2t.emulators.reskin_board --link /tmp/skin
    python -m i2t.hardware.reskin --port /tmp/skin

Its first line of output is the port's path (the link, if there is one), its second, with `--field`, where to send
fields. Like a board it waits until somebody opens the port. At rest it shows a uniform ambient field on the turned
chips of its board (`i2t.skin.boards`), noise and steps as measured on real boards; a press comes and goes where asked
for. Times of faults count from the first opening. Runs on Linux and macOS, without JAX.
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
from i2t.emulators import processes
from i2t.hardware.reskin.layouts import Format, encode
from i2t.skin.boards import make_board
from i2t.types import Board

AMBIENT_UT = (18.0, -7.0, -41.0)  # in tool axes: the Earth's, about
NOISE_UT = (3.1, 3.1, 4.6)  # standard deviation of a sample of x, y and z on real boards
STEPS_UT = (0.150, 0.150, 0.242)  # of the converter at the paper's settings
BOARD_TEMPERATURE_C, TEMPERATURE_NOISE_C, TEMPERATURE_STEP_C = 24.6, 0.1, 1 / 45.2
TEMPERATURE_ORIGIN_C = 25.0  # from which the converter counts
PRESS_UT = np.array([[9, 4, -38], [-14, 8, 12], [6, 20, 9], [-5, -16, 7], [11, -9, 13.0]])  # of chips, over and over
PRESS_PERIOD_S = 4.0
started = partial(processes.started, "i2t.emulators.reskin_board")  # with options: yields its port and its process
RUBBISH_BYTES = 60  # at a time, from a board that starts
IDLE_S = 0.01  # between two looks whether somebody has opened the port
TERMIOS_SPEEDS = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
}


@dataclass(frozen=True)
class EmulatedBoardArgs:
    """An emulated ReSkin, AnySkin or eFlesh board."""

    link: Path | None = None  # name the port: a symbolic link that is made and removed
    board: str = "reskin"  # reskin, anyskin, or grid-RxC for R rows and C columns of chips
    format: tyro.conf.EnumChoicesFromValues[Format] = Format.BINARY  # what firmware it has
    rate: float = 400.0  # frames a second
    noise: float = 1.0  # times that of real boards; 0 repeats one frame exactly
    press: float = 0.0  # size of a press every 4 s, times 57 uT (norm on 5 chips)
    field: bool = False  # take the field (3 float32 a chip, little-endian, uT) from UDP datagrams
    fail: tuple[int, ...] = ()  # chips that do not answer
    fail_after: float = 0.0  # s until they stop answering
    freeze_after: float = float("inf")  # s until it sends the same values for ever
    fail_share: float = 0.0  # part of the samples in which a chip does not answer, each chip by itself
    empty: int = 1  # only every Nth frame holds values: the sketch reads faster than the chips measure
    skip: float = 0.0  # part of the frames that are lost as a whole
    garbage_for: float = 0.0  # s of rubbish after each opening, which resets the board
    silent_after: float = float("inf")  # s until it falls silent
    silent_for: float = float("inf")  # s that it stays so
    unplug_after: float = float("inf")  # s until it is unplugged
    replug_after: float = float("inf")  # s until it is back, under the same link
    baud: int | None = None  # a real UART: any other rate gives rubbish
    seed: int = 0  # of noise and damage
    tethered: bool = False  # end when standard input closes, with the program that started it


class Readings:
    """Readings of the chips, sample after sample.

    Args:
        noise: Times that of real boards.
        press: Size of the presses that come and go.
        seed: Of the noise.
        board: Whose chips they are; by default ReSkin's.
    """

    def __init__(self, noise: float, press: float, seed: int, board: Board | None = None) -> None:
        board = make_board("reskin") if board is None else board
        self.chips = len(board.chips)
        self._rng = np.random.default_rng(seed)
        self._press = press * np.resize(PRESS_UT, (self.chips, 3)).ravel()
        self._noise = noise
        # uT, without noise and press; it may be another one later
        self.field = np.asarray(board.to_board(np.tile(AMBIENT_UT, (self.chips, 1))))

    def at(self, now: float) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " chips"]]:
        """One sample.

        Args:
            now: s, from when the board was opened.

        Returns:
            The reading (uT) and the chips' temperatures (degrees Celsius).
        """
        depth = max(0.0, np.sin(2 * np.pi * now / PRESS_PERIOD_S)) ** 2
        noise = self._noise * np.tile(NOISE_UT, self.chips) * self._rng.standard_normal(3 * self.chips)
        steps = np.tile(STEPS_UT, self.chips)
        counts = np.round((self.field + depth * self._press + noise) / steps)
        counts = (counts + 2**15) % 2**16 - 2**15  # a converter of 16 bits wraps around
        warmth = BOARD_TEMPERATURE_C + self._noise * TEMPERATURE_NOISE_C * self._rng.standard_normal(self.chips)
        celsius = np.round((warmth - TEMPERATURE_ORIGIN_C) / TEMPERATURE_STEP_C)
        return counts * steps, TEMPERATURE_ORIGIN_C + celsius * TEMPERATURE_STEP_C


class BoardPort:
    """The board's end of a pseudo-terminal, which may be unplugged; `link` names its other end.

    Args:
        link: A path that names the other end; None for none.
    """

    def __init__(self, link: Path | None) -> None:
        self._link = link
        self.master: int | None = None

    @property
    def plugged(self) -> bool:
        """Tell whether there is a port."""
        return self.master is not None

    def plug(self) -> str:
        """Make the port; returns its path."""
        self.master, slave = os.openpty()
        tty.setraw(slave)
        port = os.ttyname(slave)
        os.close(slave)  # so that it shows whether somebody else has it open
        os.set_blocking(self.master, False)
        if self._link is None:
            return port
        self._unlink()
        self._link.symlink_to(port)
        return str(self._link)

    def unplug(self) -> None:
        """Take the port away from whoever has it open."""
        if self.master is not None:
            os.close(self.master)
            self.master = None
        self._unlink()

    def is_open(self) -> bool:
        """Tell whether somebody has the port open."""
        if self.master is None:
            return False
        poll = select.poll()
        poll.register(self.master, select.POLLIN)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    def baud_rate(self) -> int:
        """Baud rate to which the port is set."""
        assert self.master is not None
        code = termios.tcgetattr(self.master)[4]
        return TERMIOS_SPEEDS.get(code, 0)

    def send(self, chunk: bytes) -> None:
        """Send bytes; what does not fit the port's buffer is lost, and so is what is sent to the board.

        Args:
            chunk: The bytes.

        Raises:
            OSError: The port is gone.
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
    """Run until SIGTERM or Ctrl-C.

    Args:
        args: Of the command line; by default those of this process.

    Returns:
        The exit code.
    """
    options = read_options(EmulatedBoardArgs, args, program="python -m i2t.emulators.reskin_board", description=__doc__)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))

    def work() -> None:
        board = make_board(options.board)
        if options.link and options.link.exists() and not options.link.is_symlink():
            raise ValueError(f"--link {options.link}: exists and is no link; give another name")
        if options.empty < 1 or any(not 0 <= chip < board.num_chips for chip in options.fail):
            raise ValueError(f"the board has chips 0 to {board.num_chips - 1}, and --empty is 1 or more")
        port = BoardPort(options.link)
        try:
            print(port.plug(), flush=True)
            _serve(port, board, options)
        except KeyboardInterrupt:
            pass
        finally:
            port.unplug()

    return exit_code_of(work)


def _serve(port: BoardPort, board: Board, options: EmulatedBoardArgs) -> None:
    readings = Readings(options.noise, options.press, options.seed, board)
    line = _Line(options)
    inbox = _field_inbox() if options.field else None
    opened: float | None = None  # when the port was first opened
    reset = -np.inf  # when it was opened last
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
            time.sleep(IDLE_S)
            due, reset = time.monotonic(), np.inf
            continue
        opened = now if opened is None else opened
        reset = min(reset, now)
        if now - reset < options.garbage_for:
            port.send(line.rubbish())
        elif not options.silent_after <= elapsed < options.silent_after + options.silent_for:
            port.send(line.frame(*readings.at(max(0.0, elapsed)), port, elapsed))
        due += 1 / options.rate
        time.sleep(max(0.0, due - time.monotonic()))


class _Line:
    """Output line of the board, which may lose samples."""

    def __init__(self, options: EmulatedBoardArgs) -> None:
        self._options, self._count = options, -1
        self._rng = np.random.default_rng((options.seed, 1))  # of rubbish
        self._faults = np.random.default_rng((options.seed, 2))  # of chips and whole frames

    def frame(self, reading: np.ndarray, temperature: np.ndarray, port: BoardPort, elapsed: float) -> bytes:
        """Bytes of a sample as it leaves the board, or as a wrong baud rate changes it; `elapsed` as faults count."""
        options = self._options
        self._count += 1
        if not self._count or elapsed < options.freeze_after:
            self._values = reading, temperature
        reading, temperature = self._values
        gone = self._faults.random(len(temperature)) < options.fail_share
        gone[list(options.fail if elapsed >= options.fail_after else ())] = True
        gone |= self._count % options.empty != 0
        whole = encode(np.where(np.repeat(gone, 3), 0.0, reading), temperature, options.format, self._count)
        if self._faults.random() < options.skip:
            return b""
        if options.baud and port.baud_rate() != options.baud:
            whole = self._rng.bytes(len(whole))
        return whole

    def rubbish(self) -> bytes:
        """Bytes that a board sends while it starts."""
        return self._rng.bytes(RUBBISH_BYTES)


def _field_inbox() -> socket.socket:
    inbox = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    inbox.bind(("127.0.0.1", 0))
    inbox.setblocking(False)
    print("field {}:{}".format(*inbox.getsockname()), flush=True)
    return inbox


def _newest_field(inbox: socket.socket, field: np.ndarray) -> np.ndarray:
    """The newest field that was sent, or the old one. That of another board ends the program, and with it the press: a
    skin that shows nothing would be pressed on and on.
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
