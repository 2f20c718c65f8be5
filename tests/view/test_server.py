"""The page without a browser: its queue, its refusals, and a running skin whose samples are all recorded."""

import csv
import resource
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from typing import NamedTuple

import numpy as np
import pytest

from i2t.emulators.reskin_board import run_board
from i2t.hardware.reskin.driver import ReSkin
from i2t.skin.boards import make_board
from i2t.view import live
from i2t.view.server import Page, Scene, ShowScene

viser = pytest.importorskip("viser", reason="viser is not installed")


class Count(NamedTuple):
    """State of a small scene."""

    message: str = "begun"
    total: int = 0


class Add(NamedTuple):
    """Event: add a number; a negative one is refused, and zero is an error of the program."""

    number: int


class Counting(Scene):
    """A scene that adds numbers once it is allowed to."""

    def __init__(self):
        super().__init__(Count())
        self.open, self.drawn, self.closed = threading.Event(), [], False

    def update(self, state, event):
        self.open.wait(10)
        if event.number < 0:
            raise ValueError("a negative number; give another")
        return Count(f"{state.total + event.number}", state.total + event.number // bool(event.number))

    def build(self, page):
        """Nothing to add."""

    def draw(self, state):
        """Keep what was shown."""
        self.drawn.append(state.total)

    def close(self):
        """Note it."""
        self.closed = True


def until(true, limit=20.0):
    deadline = time.monotonic() + limit
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture
def shown():
    """A page that shows the counting scene, and a way to choose another one."""
    scene = Counting()
    page = Page({"counting": lambda: scene, "none": lambda: 1 / 0}, host="127.0.0.1", port=18080)
    page._thread.start()
    page.send(ShowScene("counting"))
    until(lambda: scene.drawn)
    yield page, scene
    page.close()


def test_a_newer_event_replaces_one_of_its_kind_that_waits(shown):
    page, scene = shown
    page.send(Add(1))
    until(lambda: not page._events)
    for number in (10, 20, 30):
        page.send(Add(number))
    scene.open.set()
    until(lambda: scene.drawn[-1] == 31)
    assert scene.drawn == [0, 1, 31]


def test_refusals_and_errors_are_shown_and_the_page_goes_on(shown, caplog):
    page, scene = shown
    scene.open.set()
    for number, message in ((-1, "a negative number; give another"), (0, "ZeroDivisionError"), (2, "2")):
        page.send(Add(number))
        until(lambda message=message: message in page.said)
    assert "could not handle Add" in caplog.text
    page.send(ShowScene("none"))
    until(lambda: "ZeroDivisionError" in page.said)
    assert scene.closed
    page.send(ShowScene("counting"))
    until(lambda: scene.drawn[-1] == 2)


def test_two_pages_have_two_addresses(shown):
    page, _ = shown
    other = Page({}, host="127.0.0.1", port=18080)
    other.server.stop()
    assert other.address != page.address


def test_an_address_of_another_machine_is_refused():
    for host in ("192.0.2.1", "nonsense.invalid"):
        with pytest.raises(ValueError, match="is not an address of this machine"):
            Page({}, host=host, port=18080)


def test_names_are_shown_as_they_are(shown):
    page, _ = shown
    page.say("a <b>\n{c} & d")
    assert "<b>a &lt;b&gt;</b><br>{c} &amp; d</p>" in page._message.content


def test_a_page_says_that_it_computes(shown):
    page, scene = shown
    page.send(Add(1))
    until(lambda: "computing ..." in page._message.content)
    scene.open.set()
    until(lambda: page.said == "1")


@pytest.mark.full
@pytest.mark.parametrize(
    ("words", "wait"), [(["live", "--skin", "emulated"], 5.0), (["--scene", "recognise"], 4.0), (["star"], 0.5)]
)
def test_ctrl_c_ends_the_command_quietly_also_while_it_computes(words, wait):
    command = [sys.executable, "-m", "i2t.view", *words, "--no-browser", "--port", "18095"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert "http://" in process.stdout.readline()
        time.sleep(wait)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=120)
    assert process.returncode == 0
    assert output.splitlines()[-1] == "ended"
    assert "Traceback" not in errors
    assert "terminate" not in errors


@pytest.mark.full
def test_a_table_on_a_full_disk_ends_with_a_whole_line_and_says_so(tmp_path):
    with run_board() as (port, _):
        scene = live.LiveScene(ReSkin(port), make_board("reskin"), None, tmp_path / "a.csv", ExitStack())
        page = Page({"live": lambda: scene}, host="127.0.0.1", port=18090)
        page._thread.start()
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        try:
            page.send(ShowScene("live"))
            until(lambda: scene.state.change is not None)
            resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, before[1]))
            scene._records = True
            until(lambda: "recording ended" in scene.state.recording)
            time.sleep(0.5)
            assert "recording ended" in page.said  # for as long as nothing else is recorded
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
            page.close()
    text = (tmp_path / "a.csv").read_text()
    assert 30_000 < len(text) <= 40_000
    assert text.endswith("\n")
    assert {line.count(",") for line in text.splitlines()} == {20}


@pytest.mark.full
def test_every_sample_of_a_running_skin_is_recorded_until_it_is_gone(tmp_path):
    with run_board("--press", "1", "--unplug-after", "6") as (port, _), ExitStack() as stack:
        skin = ReSkin(port)
        scene = live.LiveScene(skin, make_board("reskin"), None, tmp_path / "a.csv", stack.pop_all())
        page = Page({"live": lambda: scene}, host="127.0.0.1", port=18090)
        page._thread.start()
        try:
            page.send(ShowScene("live"))
            until(lambda: scene.state.change is not None)
            before = skin.counters.samples
            scene._records = True
            until(lambda: scene.state.recording)
            after = skin.counters.samples
            until(lambda: np.linalg.norm(scene.state.change) > 30)
            until(lambda: "is gone" in page.said)
            received = skin.counters.samples
            until(lambda: "samples" in scene.state.recording)
        finally:
            page.close()
    rows = list(csv.DictReader((tmp_path / "a.csv").read_text().splitlines()))
    steps = np.diff([float(row["time_s"]) for row in rows])
    assert f"a.csv holds {len(rows)} samples" in scene.state.recording
    assert received - after <= len(rows) <= received - before + 1
    assert (steps >= 0).all()
    assert all(row["b4z_uT"] for row in rows)


@pytest.mark.full
def test_a_skin_that_was_unplugged_is_connected_again(tmp_path):
    link = tmp_path / "skin"
    with run_board("--link", str(link), "--unplug-after", "3", "--replug-after", "4"):
        scene = live.LiveScene(ReSkin(str(link)), make_board("reskin"), None, tmp_path / "a.csv", ExitStack())
        page = Page({"live": lambda: scene}, host="127.0.0.1", port=18090)
        page._thread.start()
        try:
            page.send(ShowScene("live"))
            until(lambda: scene.state.change is not None)
            until(lambda: "is gone" in page.said)
            until(link.exists)
            scene._connects = True
            until(lambda: scene.state.change is not None)
            assert "is gone" not in page.said
        finally:
            page.close()
