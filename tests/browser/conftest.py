"""Fixture with a headless Chromium for the tests of the gallery and the studio."""

import os
import shutil
import time
from collections.abc import Iterator
from typing import Any

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service


class Browser(webdriver.Chrome):
    def wait_for(self, condition: str, timeout_s: float = 60) -> Any:
        """Wait until a JavaScript expression is true and return its value."""
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            if value := self.execute_script(f"return {condition}"):
                return value
            time.sleep(0.1)
        raise AssertionError(f"condition is not true after {timeout_s} s: {condition}")

    def console_errors(self) -> list[str]:
        """Return the errors that the page logged since the last call."""
        return [line["message"] for line in self.get_log("browser") if line["level"] == "SEVERE"]


@pytest.fixture
def browser() -> Iterator[Browser]:
    """A new headless Chromium.

    If Chromium or its driver is missing, the test is skipped. If $CI is true, the test fails.
    """
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (chromium and driver):
        reason = "chromium or chromedriver is missing: run apt-get install -y chromium chromium-driver"
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(reason)
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in (
        "headless=new",
        "no-sandbox",
        "disable-background-networking",
        "disable-component-update",
        "disable-dev-shm-usage",
        "disable-sync",
        "no-first-run",
        "use-angle=swiftshader",
        "enable-unsafe-swiftshader",
        "window-size=1300,900",
    ):
        options.add_argument(f"--{argument}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    started = Browser(options=options, service=Service(driver))
    yield started
    started.quit()
