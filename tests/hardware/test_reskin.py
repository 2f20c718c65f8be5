"""The skin's driver against a board in another process."""

import contextlib
import errno
import os
import re
import socket
import subprocess
import sys
import time
import tty
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.waiting import PATIENCE, eventually

from i2t.emulators.reskin_board import Readings, run_board
from i2t.errors import DeviceError
from i2t.hardware import serial_port
from i2t.hardware.contract import refuse
from i2t.hardware.reskin import driver
from i2t.hardware.reskin.driver import BoardInfo, BoardSearch, ReSkin
from i2t.hardware.reskin.layouts import Format, encode

REST = Readings(0.0, 0.0, 0).at(0.0)[0]  # uT, of an emulated board without noise


def failure(skin, words: str) -> str:
    """Message of a skin once it fails with these words."""
    messages: list[str] = []

    def ask() -> bool:
        try:
            skin.latest()
        except DeviceError as error:
            messages.append(str(error))
        return bool(messages) and words in messages[-1]

    eventually(ask)
    return messages[-1]


@pytest.mark.parametrize("form", Format)
def test_the_driver_finds_the_format(form):
    with run_board("--format", form) as (port, _), ReSkin(port) as skin:
        samples = skin.read(40, PATIENCE)
        assert skin.info == BoardInfo(port, 115200, form)  # a pseudo-terminal has any rate
        np.testing.assert_allclose(samples.reading.mean(axis=0), REST, atol=5 * 4.6 / np.sqrt(40))
        assert skin.counters.lost == 0


def test_unplugging_is_noticed_and_replugging_resumes(tmp_path):
    link = tmp_path / "skin"
    with run_board("--link", str(link), "--unplug-after", "0.5", "--replug-after", "0.8") as (port, _):
        skin = ReSkin(port)
        assert skin.features.source == "emulated"
        with skin:
            skin.read(20, PATIENCE)
            message = failure(skin, "is gone")
            assert re.fullmatch(r"the skin on .* is gone \(.*\); plug it in and connect again", message)
            before = skin.counters.samples
            assert len(skin.since(-1).number) == before  # what came is still there
            refuse(DeviceError, [(skin.read, (1,), "is gone"), (skin.since, (before,), "is gone")])

            def again() -> bool:
                with contextlib.suppress(DeviceError):
                    skin.connect()
                    return True
                return False

            eventually(again)
            assert skin.read(20, PATIENCE).number[0] >= before
            assert np.all(np.diff(skin.since(-1).time) >= 0)


def test_silence_is_detected_and_a_busy_computer_not_blamed_on_the_board(monkeypatch):
    with run_board("--silent-after", "0.4", "--silent-for", "2.0") as (port, _), ReSkin(port) as skin:
        assert "check its cable" in failure(skin, "has been silent for")
        skin.read(20, PATIENCE)
        skin.latest(PATIENCE)
        monkeypatch.setattr(skin, "receive", lambda port: time.sleep(PATIENCE / 20) or [])
        assert "too busy to listen" in failure(skin, "this computer")


@pytest.mark.full
def test_a_wrong_baud_rate_is_reported():
    search = BoardSearch(first_frame_timeout=0.3, startup_time=0.0)
    with run_board("--baud", "460800") as (port, _), pytest.raises(DeviceError, match=r"at 9600 baud .* the baud rate"):
        ReSkin(port, 9600, search=search).connect()


def test_a_port_that_cannot_be_opened_is_reported_with_the_reason(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with run_board() as (port, _), ReSkin(port):
        calls = [
            (ReSkin(port).connect, (), "already open in this program"),
            (ReSkin(str(tmp_path / "nowhere")).connect, (), r"there is no port .*nowhere"),
            (ReSkin(str(tmp_path / "file")).connect, (), "is it a serial port"),
        ]
        refuse(DeviceError, calls)
    for error, why in (
        (OSError(errno.EBUSY, "Device or resource busy"), "in use by another program"),
        (OSError("Could not exclusively lock port"), "in use by another program"),
        (OSError(errno.EACCES, "Permission denied"), "may not be opened"),
    ):
        assert why in ReSkin(port)._open_problem(port, error)


@contextlib.contextmanager
def reader_of(port: str, lock: bool = False):
    """Another program that reads a port, with or without a lock; yields its process id."""
    code = f"""import fcntl, os
line = os.open({port!r}, os.O_RDONLY | os.O_NOCTTY)
fcntl.flock(line, fcntl.LOCK_EX) if {lock} else None
print(flush=True)
while True:
    os.read(line, 1)"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        try:
            process.stdout.readline()
            yield process.pid
        finally:
            process.kill()


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for other programs in /proc")
def test_a_port_read_by_another_program_is_not_reported_as_unplugged(tmp_path):
    link = tmp_path / "skin"  # of another name, as udev gives
    with run_board("--link", str(link)) as (port, _):
        for lock, problem in (False, r"is also read by \S+ \(process %d\)"), (True, r"in use by \S+ \(process %d\)"):
            with reader_of(port, lock) as other, pytest.raises(DeviceError, match=problem % other):
                ReSkin(str(link)).connect()
        with ReSkin(port) as skin:
            skin.read(5, PATIENCE)
            with reader_of(port) as other:
                sentence = failure(skin, f"(process {other})")
            assert "close that program" in sentence
            assert "plug" not in sentence
            assert "cable" not in sentence
        with ReSkin(port) as skin:
            skin.read(5, PATIENCE)
            refuse(DeviceError, [(ReSkin(port).connect, (), "already open in this program")])


def test_a_second_reader_that_the_system_does_not_show_is_named_as_a_cause(tmp_path):
    port = tmp_path / "port"
    shared = OSError("device reports readiness to read but returned no data (device disconnected or multiple access?)")
    assert "is gone" in str(ReSkin(str(port))._lost_error(shared))
    port.touch()  # it is still there
    sentence = str(ReSkin(str(port))._lost_error(shared))
    assert "unplugged for a moment, or another program reads the port too" in sentence
    assert "is gone" in str(ReSkin(str(port))._lost_error(OSError(errno.EIO, "Input/output error")))


def test_a_real_port_is_locked_against_other_programs(monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    if sys.platform != "linux":
        pytest.skip("only Linux tells whether a terminal is exclusive")
    get_exclusive = 0x80045440  # TIOCGEXCL of Linux

    def exclusive() -> int:
        with open(port, "rb", buffering=0, opener=lambda path, flags: os.open(path, flags | os.O_NOCTTY)) as line:
            return int.from_bytes(fcntl.ioctl(line, get_exclusive, bytes(4)), sys.byteorder)

    master, slave = os.openpty()
    port = os.ttyname(slave)
    os.set_blocking(master, False)
    try:
        skin = ReSkin(port)
        monkeypatch.setattr(driver, "other_users", lambda port: "")
        monkeypatch.setattr(driver, "_source", lambda port: "real")
        line = skin._open_port(port, 115200)
        kept = int.from_bytes(fcntl.ioctl(line.fileno(), get_exclusive, bytes(4)), sys.byteorder)
        skin.close_link(line)
        assert (kept, exclusive()) == (1, 0)
    finally:
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize(
    ("groups", "members", "words"),
    [
        ([], [], "add yourself to its group and log in again: sudo usermod -aG dialout"),
        ([], ["ada"], "you joined its group, dialout, after you logged in"),
        ([20], ["ada"], "may not be opened by your group, dialout; allow it: sudo chmod g+rw"),
    ],
)
def test_a_forbidden_port_is_reported_with_its_group_and_remedy(monkeypatch, groups, members, words):
    monkeypatch.setenv("USER", "ada")
    monkeypatch.setattr(serial_port.os, "getgroups", lambda: groups)
    monkeypatch.setattr(serial_port.os, "getegid", lambda: 1000)
    monkeypatch.setattr(serial_port.os, "stat", lambda path: SimpleNamespace(st_gid=20))
    monkeypatch.setattr(serial_port.grp, "getgrgid", lambda number: ("dialout", "x", number, members))
    assert words in serial_port.explain_no_access("/dev/ttyACM0")


def test_a_full_queue_drops_the_oldest_samples():
    with run_board("--rate", "2000") as (port, _), ReSkin(port, rate=2000.0, capacity=50) as skin:
        skin.since(-1)
        first = skin.read(1, PATIENCE).number[-1]
        skin.since(first - 1)
        eventually(lambda: skin.counters.samples > first + 300)
        late = skin.since(first)
        assert len(late.number) == 50
        assert late.number[0] > first + 1 + 50
        with pytest.raises(ValueError, match="queue holds"):
            skin.read(51)


def test_a_late_read_is_dated_back_and_the_reader_does_not_die_quietly():
    skin, board, late = ReSkin("/dev/skin"), Readings(1.0, 0.0, 0), 0.3
    whole = [encode(*board.at(0.0)) for _ in range(120)]
    chunks = [b"".join(whole[20:]), b"".join(whole[:20])]

    def read(size: int) -> bytes:
        time.sleep(late if len(chunks) == 1 else 0.0)
        return chunks.pop()  # and then an error that no port should raise

    port = Mock(in_waiting=1, read=read)
    skin._serial = lambda *_, **__: port
    skin.connect()
    failure(skin, "the skin on /dev/skin is gone")
    eventually(lambda: port.close.called)
    times = skin.since(-1).time
    assert len(times) == len(whole)  # what came before the error is still there
    steps = np.diff(times[20:])  # the late chunk's frames, at the rate of the last second: 100 since the first chunk
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-6)
    assert 0.99 * late <= 99 * steps.mean() <= PATIENCE
    assert (np.diff(times) >= 0).all()


def test_a_stream_can_be_closed_from_any_thread_at_once():
    with run_board() as (port, process):
        skin = ReSkin(port)
        skin.connect()
        with ThreadPoolExecutor() as pool:
            waiting = pool.submit(skin.read, 4000, PATIENCE)
            time.sleep(0.1)
            pool.submit(skin.close).result(PATIENCE / 2)
            with pytest.raises(DeviceError, match=f"^the skin on {port} was closed; connect it again$"):
                waiting.result(PATIENCE / 4)
        process.stdin.close()  # the board ends with the program that started it
        assert process.wait(PATIENCE) == 0
        process.stdin = None


def usb(device: str, vid: int | None, serial_number: str | None = None) -> SimpleNamespace:
    return SimpleNamespace(device=device, vid=vid, pid=1, description="QT Py", serial_number=serial_number)


def test_ports_are_found_by_vendor_and_a_board_under_another_name_is_recognised(monkeypatch):
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
    """Send a field to a board that has printed its address."""
    host, number = process.stdout.readline().split()[1].split(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.sendto(np.asarray(field, "<f4").tobytes(), (host, int(number)))


def test_bytes_sent_before_opening_are_not_read():
    """A board that has sent for a second to an unread port has filled its buffer with old samples."""
    with run_board("--field", "--noise", "0") as (port, process):
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
def test_an_emulated_board_of_another_size_works_end_to_end(form):
    switches = ("--board", "grid-2x2", "--field", "--noise", "0", "--fail", "1", "--format", form)
    with run_board(*switches) as (port, process):
        with pytest.raises(DeviceError, match="frames of 4 chips arrive, not of 5; name the right board"):
            ReSkin(port, 115200).connect()
        with ReSkin(port, 115200, chips=4) as skin:
            still = skin.read(5, PATIENCE).reading[-1]
            assert np.isnan(still).tolist() == np.isin(np.arange(12), (3, 4, 5)).tolist()
            feel(process, 15 * np.arange(12.0))
            eventually(lambda: np.nan_to_num(skin.read(1, PATIENCE).reading[0] - still).any())
            felt = skin.read(1, PATIENCE).reading[0]
    np.testing.assert_allclose(felt, np.where(np.isnan(still), np.nan, 15 * np.arange(12.0)), atol=0.25)


@pytest.mark.full
def test_the_baud_rate_is_found_and_rubbish_after_a_reset_is_waited_out():
    search = BoardSearch(baud_rates=(115200, 921600))
    switches = ("--format", "framed", "--garbage-for", "1.6", "--baud", "921600")
    with run_board(*switches) as (port, _), ReSkin(port, search=search) as skin:
        assert np.isfinite(skin.read(20, PATIENCE).reading).all()
        assert (skin.info.baud, skin.info.form) == (921600, Format.FRAMED)
