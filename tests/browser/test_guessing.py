"""Test of the page on which a reader guesses which scenes are generated."""

from helpers import random_scene

from pipelines.reporting.guess_page import render_guess_html


def test_guess_page_counts_first_answers(browser, tmp_path):
    page = tmp_path / "guess.html"
    page.write_text(render_guess_html([random_scene(0, n=5)], [random_scene(1, n=5), random_scene(2, n=5)], "guess"))
    browser.get(page.as_uri())
    assert "first answer counts" in browser.find_element("id", "result").text
    for figure in browser.find_elements("css selector", ".guess figure"):
        for button in reversed(figure.find_elements("tag name", "button")):  # The second answer does not count.
            button.click()
    notes = [note.text for note in browser.find_elements("css selector", ".guess figure span")]
    assert sorted(notes) == ["right: generated", "right: generated", "wrong: real"]
    assert browser.find_element("id", "result").text.startswith("2 of 3 right. Without looking: 1.5 ± 1.7")
    assert not browser.console_errors()
