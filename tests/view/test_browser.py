"""The page in a real browser (headless Chromium, with WebGL in software): clicks, sliders, buttons, and what appears.

`I2T_SCREENSHOTS=DIR` keeps a picture of each scene, 1280 and 390 pixels wide, for a person to look at.
"""

import ast
import os
import re
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

import i2t
from tools.film.browser import PHONE, WIDE, explain_no_browser, open_browser, serve_page

pytestmark = [pytest.mark.full, pytest.mark.skipif(bool(explain_no_browser()), reason=explain_no_browser())]
FIRST_S = 120  # s, limit of what compiles


@pytest.fixture(scope="module")
def browser():
    with open_browser() as browser:
        yield browser


@pytest.fixture
def opened(browser):
    """A function that starts `i2t view` and opens its page."""
    with ExitStack() as stack:

        def open_page(*words):
            browser.open(stack.enter_context(serve_page(words)))
            return browser

        yield open_page


def keep(browser, name):
    """Keep screenshots for a person."""
    if folder := os.environ.get("I2T_SCREENSHOTS"):
        for size in (WIDE, PHONE):
            browser.resize(size)
            time.sleep(2)
            browser.save(Path(folder) / f"{name}_{size[0]}.png")
        browser.resize(WIDE)


def mug():
    """A mug of 80 mm with a handle, as a mesh of trimesh."""
    import trimesh

    wall = trimesh.creation.annulus(r_min=0.034, r_max=0.04, height=0.08, sections=48)
    floor = trimesh.creation.cylinder(radius=0.04, height=0.006, sections=48)
    floor.apply_translation((0, 0, -0.037))
    handle = trimesh.creation.torus(0.022, 0.005, major_sections=32, minor_sections=16)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    handle.apply_translation((0.045, 0, 0))
    return trimesh.boolean.union([wall, floor, handle], engine="manifold")


def numbers(browser):
    """Arrays of the page by their names; None while there are none."""
    parts = re.findall(r"(T_o_t|predicted|± std|simulated) \(\S+\)\n(\[\[.*?\]\])", browser.text, re.DOTALL)
    return {name: np.array(ast.literal_eval(array)) for name, array in parts}


def pressed(browser, before=None):
    """Wait for the numbers of another touch."""

    def other():
        shown = numbers(browser)
        same = before is not None and all(np.array_equal(shown.get(name), before[name]) for name in before)
        return None if same or "predicted" not in shown else shown

    return browser.until(other, FIRST_S)


def test_a_click_on_a_mug_shows_its_predicted_reading_and_the_force_changes_it(opened, tmp_path):
    mug().export(tmp_path / "mug.stl")
    browser = opened(str(tmp_path / "mug.stl"), "--unit", "m")
    first = pressed(browser)
    clicked = next(
        shown
        for across in (0.42, 0.46, 0.5, 0.54)
        if (shown := (browser.click(across, 0.62), time.sleep(3), numbers(browser))[-1]).get("predicted") is not None
        and not np.array_equal(shown["T_o_t"], first["T_o_t"])
    )
    mesh = i2t.load_mesh(tmp_path / "mug.stl", unit="m")
    predictor = i2t.load_predictor("nominal")
    force = float(re.search(r"mug, (\S+) N", browser.text)[1])
    mean, std = predictor.predict_touch(mesh, clicked["T_o_t"], force=force)
    np.testing.assert_allclose(np.ravel(clicked["predicted"]), mean, atol=0.3)  # shown with one decimal
    np.testing.assert_allclose(np.ravel(clicked["± std"]), std, atol=0.3)
    keep(browser, "explore")
    field = next(part for part in browser.driver.find_elements("tag name", "input") if part.is_displayed())
    field.send_keys("\b" * 8 + "2\n")
    browser.until(lambda: "mug, 2.00 N" in browser.text)
    harder = pressed(browser, {"predicted": clicked["predicted"]})
    np.testing.assert_array_equal(harder["T_o_t"], clicked["T_o_t"])
    mean, _ = predictor.predict_touch(mesh, clicked["T_o_t"], force=2.0)
    np.testing.assert_allclose(np.ravel(harder["predicted"]), mean, atol=0.3)


def test_two_touches_of_an_episode_move_the_belief(opened):
    browser = opened("--scene", "recognise", "--objects", "star", "cylinder", "hammer")
    browser.until(lambda: "not touched yet" in browser.text, FIRST_S)
    assert " 33% star" in browser.text
    browser.press("touch where it asks")
    browser.until(lambda: "1 of 1 touches of the star (simulated)" in browser.text, FIRST_S)
    browser.press("touch where it asks")
    browser.until(lambda: re.search(r"2 of 2 touches|no more touch is needed", browser.text))
    assert int(re.search(r"(\d+)% star", browser.text)[1]) > 33
    keep(browser, "recognise")
    browser.press("begin again")
    browser.until(lambda: "not touched yet" in browser.text)


def test_touches_are_replayed_and_another_scene_is_chosen(opened):
    browser = opened("nominal")
    browser.until(lambda: "touch 1 of 180: hexagon (simulated)" in browser.text, FIRST_S)
    browser.press("next")
    browser.until(lambda: "touch 2 of 180" in browser.text)
    assert re.search(r"\d\.\d\d N, \d\.\d\d mm of travel, \d+\.\d\d µT off", browser.text)
    keep(browser, "replay")
    browser.press("explore")
    browser.until(lambda: "predicted" in numbers(browser), FIRST_S)


def test_an_emulated_skin_is_seen_being_pressed(opened):
    browser = opened("live", "--skin", "emulated")
    browser.until(lambda: "healthy at rest" in browser.text, FIRST_S)
    change = lambda: float(re.search(r"change of all chips: (\S+) µT", browser.text)[1])  # noqa: E731
    browser.until(lambda: change() > 40)
    keep(browser, "live")
    browser.until(lambda: change() < 15)
    assert "(emulated)" in browser.text
    assert "lost 0 (0.00 %)" in browser.text
