"""The skin's driver against a board in another process."""

import contextlib
import errno
import os
import re
import socket
import threading
import time
import tty
from types import SimpleNamespace

import numpy as np
import pytest

from i2t.emulators.reskin_board import Readings, started
from i2t.errors import DeviceError, DeviceTimeoutError
from i2t.hardware.reskin import driver
from i2t.hardware.reskin.driver import BoardInfo, ReSkin
from i2t.hardware.reskin.layouts import Format, encode

PATIENCE = 20.0  # s that a loaded machine may need for what takes a moment
REST = Readings(0.0, 0.0, 0).at(0.0)[0]  # uT, of an emulated board without noise


def stream(count: int, seed: int = 0) -> list[bytes]:
    board = Readings(1.0, 0.0, seed)
    return [encode(*board.at(0.0)) for _ in range(count)]


def until(found) -> None:
    """Ask again until it is so."""
    end = time.monotonic() + PATIENCE
    while not found():
        assert time.monotonic() < end
        time.sleep(0.01)


def failure(skin, words: str) -> str:
    """What the skin says once it fails with these words."""
    said: list[str] = []

    def ask() -> bool:
        try:
            skin.latest()
        except DeviceError as error:
            said.append(str(error))
        return bool(said) and words in said[-1]

    until(ask)
    return said[-1]


@pytest.mark.parametrize("form", Format)
def test_the_driver_finds_the_format(form):
    with started("--format", form) as (port, _), ReSkin(port) as skin:
        samples = skin.read(40, PATIENCE)
        assert skin.info == BoardInfo(port, 115200, form)  # a pseudo-terminal has any rate
        np.testing.assert_allclose(samples.reading.mean(axis=0), REST, atol=5 * 4.6 / np.sqrt(40))
        assert skin.counters.lost == 0


def test_unplugging_is_noticed_and_replugging_resumes(tmp_path):
    link = tmp_path / "skin"
    with started("--link", str(link), "--unplug-after", "0.5", "--replug-after", "0.8") as (port, _):
        skin = ReSkin(port)
        assert skin.features.source == "emulated"
        with skin:
            skin.read(20, PATIENCE)
            said = failure(skin, "is gone")
            assert re.fullmatch(r"the skin on .* is gone \(.*\); plug it in and connect again", said)
            before = skin.counters.samples
            assert len(skin.since(-1).number) == before  # what came is still there
            for call in (lambda: skin.read(1), lambda: skin.since(before)):
                with pytest.raises(DeviceError, match="is gone"):
                    call()

            def again() -> bool:
                with contextlib.suppress(DeviceError):
                    skin.connect()
                    return True
                return False

            until(again)
            assert skin.read(20, PATIENCE).number[0] >= before
            assert skin.counters.connects == 2
            assert np.all(np.diff(skin.since(-1).time) >= 0)


def test_silence_is_noticed_and_ends_and_a_busy_computer_does_not_blame_the_board(monkeypatch):
    with started("--silent-after", "0.4", "--silent-for", "2.0") as (port, _), ReSkin(port) as skin:
        assert "check its cable" in failure(skin, "has been silent for")
        with pytest.raises(DeviceTimeoutError, match="samples in"):
            skin.read(4000, timeout=0.05)
        skin.read(20, PATIENCE)
        skin.latest(PATIENCE)
        monkeypatch.setattr(skin, "receive", lambda port: time.sleep(PATIENCE / 20) or [])
        assert "too busy to listen" in failure(skin, "this computer")


@pytest.mark.full
def test_the_baud_rate_is_found_or_said_to_be_wrong(monkeypatch):
    monkeypatch.setattr(driver, "FIRST_FRAME_S", 0.3)
    with started("--baud", "460800") as (port, _):
        with monkeypatch.context() as hurried:
            hurried.setattr(driver, "START_UP_S", 0.0)
            with pytest.raises(DeviceError, match=r"at 9600 baud .* check the baud rate"):
                ReSkin(port, 9600).connect()
        with ReSkin(port) as skin:
            assert skin.info.baud == 460800


def test_what_cannot_be_opened_says_why(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with started() as (port, _), ReSkin(port):
        for skin, why in (
            (ReSkin(port), "in use by another program"),
            (ReSkin(str(tmp_path / "nowhere")), r"there is no port .*nowhere"),
            (ReSkin(str(tmp_path / "file")), "is it a serial port"),
        ):
            with pytest.raises(DeviceError, match=why):
                skin.connect()
    for error, why in (
        (OSError(errno.EBUSY, "Device or resource busy"), "in use by another program"),
        (OSError("Could not exclusively lock port"), "in use by another program"),
        (OSError(errno.EACCES, "Permission denied"), "may not be opened"),
    ):
        assert why in ReSkin(port)._why_closed(port, error)


def test_the_queue_lets_go_of_the_oldest():
    with started("--rate", "2000") as (port, _), ReSkin(port, rate=2000.0, capacity=50) as skin:
        skin.since(-1)
        first = skin.read(1, PATIENCE).number[-1]
        skin.since(first - 1)
        until(lambda: skin.counters.samples > first + 300)
        late = skin.since(first)
        assert len(late.number) == 50
        assert late.number[0] > first + 1 + 50
        with pytest.raises(ValueError, match="queue holds"):
            skin.read(51)


class Port:
    """A port that gives what it is told, the last chunk late, then fails."""

    def __init__(self, chunks, error, at: str, late: float = 0.0) -> None:
        self.chunks, self.error, self.at, self.late, self.closed = list(chunks), error, at, late, False

    @property
    def in_waiting(self) -> int:
        if not self.chunks and self.at == "in_waiting":
            raise self.error
        return len(self.chunks[0]) if self.chunks else 0

    def read(self, size: int) -> bytes:
        if not self.chunks:
            raise self.error
        if len(self.chunks) == 1:
            time.sleep(self.late)
        return self.chunks.pop(0)

    def reset_input_buffer(self) -> None:
        pass

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize(
    ("error", "at"), [(OSError(5, "Input/output error"), "in_waiting"), (TypeError("NoneType"), "read")]
)
def test_the_reader_never_dies_quietly(error, at):
    skin = ReSkin("/dev/skin")
    port = Port([b"".join(stream(20)), *stream(20, seed=1)], error, at)
    skin._serial = lambda *_, **__: port
    skin.connect()
    failure(skin, "the skin on /dev/skin is gone")
    assert len(skin.since(-1).number) == 40
    assert port.closed
    skin.close()
    with pytest.raises(DeviceError):
        skin.read(1)


def test_a_late_read_is_dated_back():
    skin, whole, late = ReSkin("/dev/skin"), stream(120), 0.3
    chunks = [b"".join(whole[:20]), b"".join(whole[20:])]
    skin._serial = lambda *_, **__: Port(chunks, OSError(5, "gone"), "read", late)
    skin.connect()
    until(lambda: skin.counters.samples == len(whole))  # a busy machine may call it silent meanwhile
    times = skin.since(-1).time
    steps = np.diff(times[20:])  # the late chunk's frames, at the rate of the last second: 100 since the first chunk
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-6)
    assert 0.99 * late <= 99 * steps.mean() <= PATIENCE
    assert (np.diff(times) >= 0).all()


def test_it_can_be_closed_from_anywhere_and_at_once():
    with started() as (port, process):
        skin = ReSkin(port)
        skin.connect()
        outcome: list[str] = []

        def wait() -> None:
            try:
                skin.read(4000, PATIENCE)
            except DeviceError as error:
                outcome.append(str(error))

        waiting, closing = threading.Thread(target=wait), threading.Thread(target=skin.close)
        waiting.start()
        time.sleep(0.1)
        closing.start()
        closing.join(PATIENCE)
        waiting.join(PATIENCE)
        assert not closing.is_alive()
        assert outcome == [f"the skin on {port} was closed; connect it again"]
        process.stdin.close()  # the board ends with the program that started it
        assert process.wait(PATIENCE) == 0
        process.stdin = None


def usb(device: str, vid: int | None, serial_number: str | None = None) -> SimpleNamespace:
    return SimpleNamespace(device=device, vid=vid, pid=1, description="QT Py", serial_number=serial_number)


def test_ports_are_found_by_who_made_the_board_and_a_board_under_another_name_is_known(monkeypatch):
    skin = ReSkin()
    there: list[SimpleNamespace] = [usb("/dev/ttyS0", None)]
    monkeypatch.setattr(skin, "_comports", lambda: there)
    with pytest.raises(DeviceError, match="no USB serial port"):
        skin.connect()
    there[:] = usb("/dev/ttyUSB0", 0x0403), usb("/dev/ttyACM0", 0x239A)
    assert skin._find() == "/dev/ttyACM0"
    assert [board.port for board in skin.ports()] == ["/dev/ttyACM0", "/dev/ttyUSB0"]
    there.append(usb("/dev/ttyACM1", 0x239A))
    with pytest.raises(DeviceError, match=r"more than one .*ttyACM0 .*ttyACM1 .*name its port"):
        skin.connect()
    skin = ReSkin("/dev/nowhere0")
    skin._info = BoardInfo("/dev/nowhere0", 115200, Format.BINARY, "QT Py", "A1", "239a:0001")
    monkeypatch.setattr(skin, "_comports", lambda: there)
    assert skin._find() == "/dev/nowhere0"  # another board is not taken for it
    there.append(usb("/dev/nowhere1", 0x239A, "A1"))
    assert skin._find() == "/dev/nowhere1"


def feel(process, field) -> None:
    """Sends a field to a board that has said where to."""
    host, number = process.stdout.readline().split()[1].split(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.sendto(np.asarray(field, "<f4").tobytes(), (host, int(number)))


def test_what_was_sent_to_nobody_is_not_read():
    """A board that talked for a second to a port that nobody read has filled its buffer with the past."""
    with started("--field", "--noise", "0") as (port, process):
        holder = os.open(port, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(holder)
        time.sleep(0.5)
        feel(process, np.full(15, 45.0))
        time.sleep(0.2)
        with ReSkin(port) as skin:
            skin.read(20, PATIENCE)
            felt = skin.since(-1).reading
        os.close(holder)
    np.testing.assert_allclose(felt, 45.0, atol=0.25)


@pytest.mark.full
@pytest.mark.parametrize("form", Format)
def test_an_emulated_board_of_another_size_is_read_and_felt_end_to_end(form):
    switches = ("--board", "grid-2x2", "--field", "--noise", "0", "--fail", "1", "--format", form)
    with started(*switches) as (port, process):
        with pytest.raises(DeviceError, match="frames of 4 chips come, not of 5; say which board it is"):
            ReSkin(port, 115200).connect()
        with ReSkin(port, 115200, chips=4) as skin:
            still = skin.read(5, PATIENCE).reading[-1]
            assert np.isnan(still).tolist() == np.isin(np.arange(12), (3, 4, 5)).tolist()
            feel(process, 15 * np.arange(12.0))
            until(lambda: np.nan_to_num(skin.read(1, PATIENCE).reading[0] - still).any())
            felt = skin.read(1, PATIENCE).reading[0]
    np.testing.assert_allclose(felt, np.where(np.isnan(still), np.nan, 15 * np.arange(12.0)), atol=0.25)


@pytest.mark.full
def test_rubbish_after_a_reset_is_waited_out(monkeypatch):
    monkeypatch.setattr(driver, "BAUD_RATES", (115200, 921600))
    switches = ("--format", "framed", "--garbage-for", "1.6", "--baud", "921600")
    with started(*switches) as (port, _), ReSkin(port) as skin:
        assert np.isfinite(skin.read(20, PATIENCE).reading).all()
        assert (skin.info.baud, skin.info.form) == (921600, Format.FRAMED)
