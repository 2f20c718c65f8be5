"""Film of the page of `i2t view`: its four scenes as one animation, for the README and docs/view.md.

python -m tools.film --out docs/figures/view.webp

All readings are simulated or emulated. It takes about two minutes and needs a browser (`tools.film.browser`).
"""

import re
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

from i2t.cli.exit_codes import command
from i2t.cli.options import docstring_of
from tools.film.browser import Browser, explain_no_browser, open_browser, serve_page

ROOT = Path(__file__).parents[2]
SIZE, SHOWN = (1120, 700), (800, 500)  # pixels, of the page and of the film
FIRST_S = 180.0  # s, limit of what compiles
STILL_MS, MOVING_MS = 1600, 120  # how long a picture is shown


@dataclass(frozen=True)
class FilmArgs:
    """Film the page of `i2t view`."""

    out: Path = ROOT / "docs/figures/view.webp"  # animation to write, a .webp or .gif


def _film(args: FilmArgs) -> None:
    if why := explain_no_browser():
        raise ValueError(why)
    frames: list[tuple[Image.Image, int]] = []
    with open_browser() as browser, TemporaryDirectory() as folder:

        def keep(milliseconds: int = STILL_MS) -> None:
            browser.save(Path(folder) / "page.png")
            with Image.open(Path(folder) / "page.png") as picture:
                frames.append((picture.convert("RGB").resize(SHOWN, Image.Resampling.LANCZOS), milliseconds))

        for words, play in (
            ((str(ROOT / "examples/data/mug.stl"), "--unit", "mm"), _explore),
            (("--scene", "recognise", "--objects", "star", "cylinder", "square", "hexagon"), _recognise),
            (("nominal",), _replay),
            (("live", "--skin", "emulated"), _live),
        ):
            with serve_page(words) as address:
                browser.open(address, SIZE)
                play(browser, keep)
    first, *rest = (frame for frame, _ in frames)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    first.save(
        args.out,
        save_all=True,
        append_images=rest,
        duration=[shown for _, shown in frames],
        loop=0,
        quality=70,
        method=6,
    )
    print(f"wrote {args.out}: {len(frames)} pictures, {args.out.stat().st_size / 1e6:.2f} MB")


def _explore(browser: Browser, keep: Callable[..., None]) -> None:
    """Press a mug at three places."""
    browser.wait_for("predicted", FIRST_S)
    time.sleep(2)
    for across, down in ((0.3, 0.55), (0.4, 0.6), (0.42, 0.42)):
        browser.click(across, down)
        time.sleep(3)
        keep()


def _recognise(browser: Browser, keep: Callable[..., None]) -> None:
    """Touch where the belief asks, until it is certain."""
    browser.wait_for("not touched yet", FIRST_S)
    time.sleep(2)
    keep()
    for touches in (1, 2, 3):
        if "no further touch" in browser.text:
            return
        browser.press("touch where it asks")
        browser.wait_for(f"{touches} of {touches} touches", FIRST_S)
        time.sleep(1)
        keep()


def _replay(browser: Browser, keep: Callable[..., None]) -> None:
    """Show three touches of a data set."""
    browser.wait_for("touch 1 of", FIRST_S)
    for number in (2, 3, 4):
        browser.press("next")
        browser.wait_for(f"touch {number} of")
        time.sleep(2)
        keep()


def _live(browser: Browser, keep: Callable[..., None]) -> None:
    """Show one press of an emulated skin."""
    browser.wait_for("healthy at rest", FIRST_S)
    change = re.compile(r"change of all chips: (\S+) µT")

    def is_pressed() -> bool:
        shown = change.search(browser.text)
        return shown is not None and float(shown[1]) > 12

    browser.until(lambda: not is_pressed())  # the film begins with a press
    browser.until(is_pressed)
    for _ in range(16):
        keep(MOVING_MS)


main = command(FilmArgs, _film, program="python -m tools.film", description=docstring_of("tools.film.__main__"))

if __name__ == "__main__":
    sys.exit(main())
