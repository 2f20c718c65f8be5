"""The page in a real browser (headless Chromium, with WebGL in software): clicks, sliders, buttons, and what appears.

`I2T_SCREENSHOTS=DIR` keeps a picture of each scene, 1280 and 390 pixels wide, for a person to look at.
"""

import ast
import os
import re
import time
from pathlib import Path

import numpy as np
import pytest

import i2t
from tools.film.browser import PHONE, WIDE, explain_no_browser, open_browser, serve_page

pytestmark = [pytest.mark.full, pytest.mark.skipif(bool(explain_no_browser()), reason=explain_no_browser())]
FIRST_S = 120  # s, limit of what compiles


@pytest.fixture(scope="module")
def mug_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("mug") / "mug.stl"
    mug().export(path)
    return path


@pytest.fixture(scope="module")
def page(mug_file):
    """A browser with the page of a mug, which has all scenes."""
    words = (str(mug_file), "--unit", "m", "--objects", "star", "cylinder", "hammer", "--skin", "emulated")
    with open_browser() as browser, serve_page(words) as address:
        browser.open(address)
        yield browser


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


def numbers(page):
    """Arrays of the page by their names; None while there are none."""
    parts = re.findall(r"(T_o_t|predicted|± std|simulated) \(\S+\)\n(\[\[.*?\]\])", page.text, re.DOTALL)
    return {name: np.array(ast.literal_eval(array)) for name, array in parts}


def pressed(page, before=None):
    """Wait for the numbers of another touch."""

    def other():
        shown = numbers(page)
        same = before is not None and all(np.array_equal(shown.get(name), before[name]) for name in before)
        return None if same or "predicted" not in shown else shown

    return page.until(other, FIRST_S)


def test_a_click_on_a_mug_shows_its_predicted_reading_and_the_force_changes_it(page, mug_file):
    first = pressed(page)
    clicked = next(
        shown
        for across in (0.42, 0.46, 0.5, 0.54)
        if (shown := (page.click(across, 0.62), time.sleep(3), numbers(page))[-1]).get("predicted") is not None
        and not np.array_equal(shown["T_o_t"], first["T_o_t"])
    )
    mesh = i2t.load_mesh(mug_file, unit="m")
    predictor = i2t.load_predictor("nominal")
    force = float(re.search(r"mug, (\S+) N", page.text)[1])
    mean, std = predictor.predict_touch(mesh, clicked["T_o_t"], force=force)
    np.testing.assert_allclose(np.ravel(clicked["predicted"]), mean, atol=0.3)  # shown with one decimal
    np.testing.assert_allclose(np.ravel(clicked["± std"]), std, atol=0.3)
    keep(page, "explore")
    field = next(part for part in page.driver.find_elements("tag name", "input") if part.is_displayed())
    field.send_keys("\b" * 8 + "2\n")
    page.until(lambda: "mug, 2.00 N" in page.text)
    mean, _ = predictor.predict_touch(mesh, clicked["T_o_t"], force=2.0)
    # The field may have held another number while it was typed.
    page.until(lambda: np.allclose(np.ravel(numbers(page).get("predicted", np.nan)), mean, rtol=0, atol=0.3))
    np.testing.assert_array_equal(numbers(page)["T_o_t"], clicked["T_o_t"])


def test_two_touches_of_an_episode_move_the_belief(page):
    page.press("recognise")
    page.until(lambda: "not touched yet" in page.text, FIRST_S)
    assert " 33% star" in page.text
    page.press("touch where it asks")
    page.until(lambda: "1 of 1 touches of the star (simulated)" in page.text, FIRST_S)
    page.press("touch where it asks")
    page.until(lambda: re.search(r"2 of 2 touches|no further touch", page.text))
    assert int(re.search(r"(\d+)% star", page.text)[1]) > 33
    keep(page, "recognise")
    page.press("begin again")
    page.until(lambda: "not touched yet" in page.text)


def test_touches_are_replayed(page):
    page.press("replay")
    page.until(lambda: "touch 1 of 180: hexagon (simulated)" in page.text, FIRST_S)
    page.press("next")
    page.until(lambda: "touch 2 of 180" in page.text)
    assert re.search(r"\d\.\d\d N, \d\.\d\d mm of travel, \d+\.\d\d µT error", page.text)
    keep(page, "replay")


def test_an_emulated_skin_is_seen_being_pressed(page):
    page.press("live")
    page.until(lambda: "healthy at rest" in page.text, FIRST_S)
    change = lambda: float(re.search(r"change of all chips: (\S+) µT", page.text)[1])  # noqa: E731
    page.until(lambda: change() > 40)
    keep(page, "live")
    page.until(lambda: change() < 15)
    assert "(emulated)" in page.text
    assert "lost 0 (0.00 %)" in page.text
