"""A ReSkin or AnySkin board that is not there: a pseudo-terminal that sends its frames, well or badly.

    python -m i2t.emulators.reskin_board --link /tmp/skin
    python -m i2t.hardware.reskin --port /tmp/skin

Its first line of output is the port's path (the link, if there is one), its second, with `--field`, where to send
fields. Like a board it waits until somebody opens the port. At rest it shows a uniform ambient field on the turned
chips of `i2t.skin.boards.reskin_board`, noise and steps as measured on real boards; a press comes and goes where
asked for. Times of faults count from the first opening. Runs on Linux and macOS; NumPy only.
"""

import argparse
import errno
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import termios
import time
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np

from i2t.hardware.reskin.frames import Format, encode
from i2t.skin import boards
from i2t.types import CHIPS, READINGS

AMBIENT = (18.0, -7.0, -41.0)  # uT in tool axes: the Earth's, about
NOISE = (3.1, 3.1, 4.6)  # uT, standard deviation of a sample of x, y and z on real boards
STEPS = (0.150, 0.150, 0.242)  # uT, of the converter at the paper's settings
CELSIUS, CELSIUS_NOISE, CELSIUS_STEP = 24.6, 0.1, 1 / 45.2
PRESS = np.array([9.0, 4.0, -38.0, -14.0, 8.0, 12.0, 6.0, 20.0, 9.0, -5.0, -16.0, 7.0, 11.0, -9.0, 13.0])  # uT
PERIOD = 4.0  # s from one press to the next
BAUDS = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}


def parser() -> argparse.ArgumentParser:
    """Its switches."""
    switches = argparse.ArgumentParser("python -m i2t.emulators.reskin_board", description=__doc__.split("\n\n")[0])
    add = switches.add_argument
    add("--link", type=Path, help="name the port: a symbolic link that is made and removed")
    add("--format", choices=[str(form) for form in Format], default=str(Format.BINARY), help="what firmware it has")
    add("--rate", type=float, default=400.0, help="frames a second")
    add("--noise", type=float, default=1.0, help="times that of real boards; 0 repeats one frame exactly")
    add("--press", type=float, default=0.0, help="size of a press every 4 s, times 57 uT (15-vector norm)")
    add("--temperature", type=float, default=None, help="of all chips, exactly; 34.513 holds CR LF in binary")
    add("--field", action="store_true", help="take fields (15 float32, little-endian, uT) from UDP datagrams")
    add("--mid-frame", type=int, default=0, help="bytes missing from the first frame")
    add("--substitute", type=float, default=0.0, help="part of the bytes that are changed")
    add("--drop", type=float, default=0.0, help="part of the bytes that are lost")
    add("--silent-after", type=float, default=np.inf, help="s until it falls silent")
    add("--silent-for", type=float, default=np.inf, help="s that it stays so")
    add("--unplug-after", type=float, default=np.inf, help="s until it is unplugged")
    add("--replug-after", type=float, default=np.inf, help="s until it is back, under the same link")
    add("--baud", type=int, default=None, help="a real UART: any other rate gives rubbish")
    add("--seed", type=int, default=0)
    add("--tethered", action="store_true", help="end when standard input closes, with the program that started it")
    return switches


class Readings:
    """What the chips measure, sample after sample."""

    def __init__(self, noise: float, press: float, temperature: float | None, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._rest = boards.reskin_board().to_board(np.tile(np.array(AMBIENT), (CHIPS, 1)))
        self._noise, self._press, self._temperature = noise, press, temperature
        self.field = np.zeros(READINGS)  # uT, added to all else

    def at(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        """Reading (15,) in uT and temperatures (5,) at `now` (s)."""
        depth = self._press * max(0.0, np.sin(2 * np.pi * now / PERIOD)) ** 2
        noisy = self._rest + self.field + depth * PRESS
        noisy = noisy + self._noise * np.tile(NOISE, CHIPS) * self._rng.standard_normal(READINGS)
        steps = np.tile(STEPS, CHIPS)
        celsius = CELSIUS + self._noise * CELSIUS_NOISE * self._rng.standard_normal(CHIPS)
        celsius = 25 + np.round((celsius - 25) / CELSIUS_STEP) * CELSIUS_STEP
        if self._temperature is not None:
            celsius = np.full(CHIPS, self._temperature)
        return np.round(noisy / steps) * steps, celsius


def spoil(chunk: bytes, substitute: float, drop: float, rng: np.random.Generator) -> bytes:
    """The bytes of a bad line: each is changed with probability `substitute`, then lost with probability `drop`."""
    data = np.frombuffer(chunk, np.uint8)
    changed = rng.random(data.size) < substitute
    data = data + np.where(changed, rng.integers(1, 256, data.size), 0).astype(np.uint8)
    return data[rng.random(data.size) >= drop].tobytes()


class Board:
    """The board's end of the pseudo-terminal."""

    def __init__(self, link: Path | None) -> None:
        self._link = link
        self.master: int | None = None

    @property
    def plugged(self) -> bool:
        """Whether there is a port."""
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

    def open(self) -> bool:
        """Whether somebody has the port open."""
        if self.master is None:
            return False
        poll = select.poll()
        poll.register(self.master, select.POLLIN)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    def speed(self) -> int:
        """Baud rate to which the port is set."""
        assert self.master is not None
        code = termios.tcgetattr(self.master)[4]
        return BAUDS.get(code, 0)

    def send(self, chunk: bytes) -> None:
        """What does not fit the port's buffer is lost, and so is what is sent to the board."""
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
    """Run until SIGTERM or Ctrl-C; returns the exit code."""
    asked = parser().parse_args(args)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if asked.link and asked.link.exists() and not asked.link.is_symlink():
        print(f"{asked.link} exists and is no link; give another name", file=sys.stderr)
        return 2
    board = Board(asked.link)
    try:
        print(board.plug(), flush=True)
        _serve(board, asked)
    except KeyboardInterrupt:
        pass
    finally:
        board.unplug()
    return 0


def _serve(board: Board, asked: argparse.Namespace) -> None:
    readings = Readings(asked.noise, asked.press, asked.temperature, asked.seed)
    rng = np.random.default_rng((asked.seed, 1))
    inbox = _inbox() if asked.field else None
    cut = asked.mid_frame
    first: float | None = None  # when the port was first opened
    due = time.monotonic()
    while not (asked.tethered and _ended(sys.stdin)):
        now = time.monotonic()
        since = -1.0 if first is None else now - first
        if inbox is not None:
            readings.field = _newest(inbox, readings.field)
        gone = asked.unplug_after <= since < asked.replug_after
        if gone and board.plugged:
            board.unplug()
        elif not gone and not board.plugged:
            board.plug()
        if gone or not board.open():
            time.sleep(0.01)
            due = time.monotonic()
            continue
        first = now if first is None else first
        if not asked.silent_after <= since < asked.silent_after + asked.silent_for:
            reading, celsius = readings.at(max(0.0, since))
            chunk = encode(reading, celsius, Format(asked.format))[cut:]
            cut = 0
            if asked.baud and board.speed() != asked.baud:
                chunk = rng.bytes(len(chunk))
            board.send(spoil(chunk, asked.substitute, asked.drop, rng) if asked.substitute or asked.drop else chunk)
        due += 1 / asked.rate
        time.sleep(max(0.0, due - time.monotonic()))


def _inbox() -> socket.socket:
    inbox = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    inbox.bind(("127.0.0.1", 0))
    inbox.setblocking(False)
    print("field {}:{}".format(*inbox.getsockname()), flush=True)
    return inbox


def _newest(inbox: socket.socket, field: np.ndarray) -> np.ndarray:
    """The newest field that was sent, or the old one; datagrams of another size are ignored."""
    try:
        while True:
            data = inbox.recv(4096)
            if len(data) == 4 * READINGS:
                field = np.array(struct.unpack(f"<{READINGS}f", data))
    except BlockingIOError:
        return field


def _ended(stream: TextIO) -> bool:
    ready, _, _ = select.select([stream], [], [], 0)
    return bool(ready) and not os.read(stream.fileno(), 1)


@contextmanager
def started(*switches: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A board in a process of its own, which ends with the block and with this program: its port and its process.
    Further lines it prints can be read from the process.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "i2t.emulators.reskin_board", "--tethered", *switches],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        port = process.stdout.readline().strip()
        if not port:
            raise RuntimeError(f"the board did not start: {' '.join(switches)}")
        yield port, process
    finally:
        process.terminate()
        process.communicate()


if __name__ == "__main__":
    sys.exit(main())
