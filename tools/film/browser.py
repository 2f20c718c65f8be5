"""A headless Chromium that looks at the page of `i2t view`, for its tests and its pictures.

It needs Debian's packages `chromium` and `chromium-driver` and selenium from the package index. WebGL runs in software.
"""

import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

OPTIONS = (
    "--headless=new", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage", "--hide-scrollbars",
)  # fmt: skip
WIDE, PHONE = (1280, 800), (390, 844)  # pixels


def explain_no_browser() -> str:
    """Explain in one sentence why no browser can be started here; an empty string if one can."""
    missing = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    if missing:
        return f"a browser needs {' and '.join(missing)}: apt-get install chromium chromium-driver"
    return "" if find_spec("selenium") else "a browser needs selenium: pip install selenium"


class Browser:
    """A browser that shows one page."""

    def __init__(self) -> None:
        from selenium import webdriver

        options = webdriver.ChromeOptions()
        options.binary_location = str(shutil.which("chromium"))
        for option in OPTIONS:
            options.add_argument(option)
        self.driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))

    @property
    def text(self) -> str:
        """All text of the page."""
        return self.driver.find_element("tag name", "body").text

    def open(self, address: str, size: tuple[int, int] = WIDE) -> None:
        """Open a page in a window of a width and height (pixels)."""
        self.resize(size)
        self.driver.get(address)

    def resize(self, size: tuple[int, int]) -> None:
        """Give the page another width and height (pixels)."""
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": size[0] < 500}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def until(self, true: Callable[[], Any], limit: float = 30.0) -> Any:
        """Wait for a condition, at most some seconds, and return its value."""
        deadline = time.monotonic() + limit
        while not (value := true()):
            if time.monotonic() > deadline:
                raise TimeoutError(f"the page still reads: {self.text}")
            time.sleep(0.02)
        return value

    def wait_for(self, text: str, limit: float = 30.0) -> None:
        """Wait until the page has a text."""
        self.until(lambda: text in self.text, limit)

    def press(self, label: str) -> None:
        """Press a button."""
        next(button for button in self.driver.find_elements("tag name", "button") if button.text == label).click()

    def click(self, across: float, down: float) -> None:
        """Click the 3-D scene at fractions of its width and height."""
        from selenium.webdriver.common.action_chains import ActionChains

        canvas = max(self.driver.find_elements("tag name", "canvas"), key=lambda part: part.size["width"])
        x, y = int((across - 0.5) * canvas.size["width"]), int((down - 0.5) * canvas.size["height"])
        ActionChains(self.driver).move_to_element_with_offset(canvas, x, y).pause(0.1).click().perform()

    def save(self, path: Path) -> None:
        """Save a picture of the page, without the note that WebGL runs in software."""
        for button in self.driver.find_elements("css selector", ".mantine-Notification-root button"):
            button.click()
            time.sleep(0.5)  # until it has faded
        path.parent.mkdir(parents=True, exist_ok=True)
        self.driver.save_screenshot(str(path))


@contextmanager
def open_browser() -> Iterator[Browser]:
    """Run a browser while the block runs."""
    browser = Browser()
    try:
        yield browser
    finally:
        browser.driver.quit()


@contextmanager
def serve_page(words: Sequence[str], port: int = 18100) -> Iterator[str]:
    """Run `i2t view` while the block runs.

    Args:
        words: Words of its command line.
        port: Port of the page; the next free one if it is taken.

    Yields:
        Address of the page.

    Raises:
        RuntimeError: The command ended without a page.
    """
    command = [sys.executable, "-m", "i2t.view", *words, "--no-browser", "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = re.search(r"http://\S+", process.stdout.readline())
        if address is None:
            raise RuntimeError(f"there is no page: {' '.join(command)}")
        try:
            yield address[0]
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(15.0)
            except subprocess.TimeoutExpired:
                process.kill()
                raise
