"""Pictures of a page by a browser without a window (Chromium, driven by selenium)."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
# No GPU is needed: SwiftShader draws WebGL on the CPU. The others keep Chromium off the network.
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
)


class NoBrowserError(ValueError):
    """What a picture needs is not installed; the message says what to install."""


def find_browser() -> tuple[str, str]:
    """Paths of Chromium and of its driver.

    Raises:
        NoBrowserError: One of them, or selenium, is missing.
    """
    try:
        import selenium  # noqa: F401
    except ImportError:
        raise NoBrowserError(
            "screenshot: needs selenium, pip install 'muxjax[dev]' (or selenium alone)"
        ) from None
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    driver = shutil.which("chromedriver")
    missing = [
        name for name, found in (("chromium", browser), ("chromedriver", driver)) if not found
    ]
    if missing or browser is None or driver is None:
        raise NoBrowserError(
            f"screenshot: no {' and no '.join(missing)} on the PATH; install them from your "
            "system's packages (Debian: apt install chromium chromium-driver)"
        )
    return browser, driver


@contextmanager
def headless_browser(width: int, height: int) -> Iterator[Chrome]:
    """A Chromium without a window, its profile empty and removed afterwards.

    Args:
        width: Of the page [pixels].
        height: Likewise.

    Raises:
        NoBrowserError: See ``find_browser``; or Chromium does not start.
    """
    binary, driver = find_browser()
    from selenium.common.exceptions import WebDriverException
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = binary
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        for flag in (*_FLAGS, f"--window-size={width},{height}", f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        try:
            opened = Chrome(options=options, service=Service(executable_path=driver))
        except WebDriverException as error:
            raise NoBrowserError(f"screenshot: {binary} does not start: {error.msg}") from None
        try:
            # The window's frame is part of its size.
            frame = opened.execute_script(
                "return [outerWidth - innerWidth, outerHeight - innerHeight]"
            )
            opened.set_window_size(width + frame[0], height + frame[1])
            yield opened
        finally:
            opened.quit()


def open_viewer(browser: Chrome, viewer: Any, timeout_s: float = 60.0) -> None:
    """Load a viewer's page and wait until it is connected and has drawn.

    Args:
        browser: Of ``headless_browser``.
        viewer: A ``Viewer``.
        timeout_s: Longest wait [s].

    Raises:
        TimeoutError: The page did not connect or draw.
    """
    browser.get(viewer.url)
    deadline = time.monotonic() + timeout_s
    while not (viewer.server.get_clients() and browser.execute_script(_HAS_CANVAS)):
        if time.monotonic() > deadline:
            log = "; ".join(str(entry["message"]) for entry in browser.get_log("browser")[-3:])
            raise TimeoutError(f"screenshot: the page was not there in {timeout_s:g} s: {log}")
        time.sleep(0.1)
    time.sleep(1.0)
    # viser warns that there is no GPU: known here, and in the way.
    for cross in browser.find_elements("css selector", ".mantine-Notification-closeButton"):
        cross.click()
    settle(browser)


_HAS_CANVAS = "return document.querySelectorAll('canvas').length > 0"


def settle(browser: Chrome, timeout_s: float = 20.0) -> bytes:
    """Wait until two pictures in a row are the same, and return it as PNG."""
    deadline = time.monotonic() + timeout_s
    before = b""
    while True:
        time.sleep(0.7)
        picture: bytes = browser.get_screenshot_as_png()
        if picture == before or time.monotonic() > deadline:
            return picture
        before = picture


def take_screenshot(viewer: Any, path: Path, size: tuple[int, int], tab: str = "Arm") -> None:
    """Open the viewer in a browser without a window and save what it shows as PNG.

    Args:
        viewer: A ``Viewer``.
        path: File to write.
        size: Width and height [pixels].
        tab: Of the panel.

    Raises:
        NoBrowserError: See ``headless_browser``.
        TimeoutError: See ``open_viewer``.
    """
    from muxjax.config import replacing

    with headless_browser(*size) as browser:
        open_viewer(browser, viewer)
        press(browser, tab)
        picture = settle(browser)
    with replacing(path) as part:
        part.write_bytes(picture)


def press(browser: Chrome, text: str, among: str = "[role=tab]") -> None:
    """Click what has this text.

    Args:
        browser: With the page.
        text: On it; capitals or not.
        among: CSS selector of what may be clicked: the tabs, by default.

    Raises:
        LookupError: There is none.
    """
    for button in browser.find_elements("css selector", among):
        if button.text.strip().lower() == text.lower() and button.is_displayed():
            button.click()
            return
    raise LookupError(f"nothing to click with {text!r} on the page")
