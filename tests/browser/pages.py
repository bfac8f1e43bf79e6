"""Headless Chromium for tests of pages."""

import shutil
import time

import pytest


def start_browser(width: int = 1300, height: int = 900):
    """A driver; skips the test where there is no browser."""
    if not (shutil.which("chromium") and shutil.which("chromedriver")):
        pytest.skip("no browser: install chromium and chromium-driver")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for argument in (
        "headless=new",
        "no-sandbox",
        "disable-background-networking",
        "disable-component-update",
        "disable-sync",
        "no-first-run",
        "use-angle=swiftshader",
        "enable-unsafe-swiftshader",
        f"window-size={width},{height}",
    ):
        options.add_argument(f"--{argument}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    return webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))


def wait_for(browser, condition: str, seconds: float = 60):
    """The value of a JavaScript expression as soon as it is true. Fails after so many seconds."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if value := browser.execute_script(f"return {condition}"):
            return value
        time.sleep(0.1)
    raise AssertionError(f"not within {seconds} s: {condition}")


def faults(browser) -> list[str]:
    """What the page complained of since last time."""
    return [line["message"] for line in browser.get_log("browser") if line["level"] == "SEVERE"]
