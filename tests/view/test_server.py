"""The page without a browser: its queue, its refusals, and a running skin whose samples are all recorded."""

import csv
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
        until(lambda message=message: message in page._message.content)
    assert "could not handle Add" in caplog.text
    page.send(ShowScene("none"))
    until(lambda: "ZeroDivisionError" in page._message.content)
    assert scene.closed
    page.send(ShowScene("counting"))
    until(lambda: scene.drawn[-1] == 2)


def test_two_pages_have_two_addresses(shown):
    page, _ = shown
    other = Page({}, host="127.0.0.1", port=18080)
    other.server.stop()
    assert other.address != page.address


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
            scene._records = True
            until(lambda: scene.state.recording)
            until(lambda: np.linalg.norm(scene.state.change) > 30)
            until(lambda: "is gone" in page._message.content)
            received = skin.counters.samples
            until(lambda: not scene._records)
        finally:
            page.close()
    rows = list(csv.DictReader((tmp_path / "a.csv").read_text().splitlines()))
    steps = np.diff([float(row["time_s"]) for row in rows])
    assert received - 1000 < len(rows) <= received
    assert steps.max() < 0.1
    assert all(row["b4z_uT"] for row in rows)
