"""Tests of the page on which a reader guesses which scenes are generated."""

import base64
import re

import numpy as np
import pytest
from helpers import random_scene

from pipelines.reporting.guess_page import render_guess_html


def read_answers(page: str) -> str:
    found = re.search(r'atob\("([^"]+)"\)', page)
    assert found
    return base64.b64decode(found[1]).decode()


def test_guess_page_hides_shuffled_answers():
    real, generated = ([random_scene(seed, n=5) for seed in range(first, first + 4)] for first in (0, 10))
    seen = []
    page = render_guess_html(real, generated, "A & B", seed=3, on_scene=lambda: seen.append(1))
    answers, pictures = read_answers(page), re.findall(r'src="(data:image/jpeg[^"]+)"', page)
    assert sorted(answers) == list("00001111") and answers not in page
    assert len(set(pictures)) == len(seen) == 8 and "A &amp; B" in page
    assert answers not in ("00001111", "11110000")
    order = np.random.default_rng(3).permutation(8)
    swapped = render_guess_html(generated, real, "A & B", seed=3)
    assert read_answers(swapped) == "".join(str(int(k >= 4)) for k in order)
    assert re.findall(r'src="(data:image/jpeg[^"]+)"', swapped) != pictures


def test_guess_page_needs_both_sides():
    with pytest.raises(ValueError, match="got 1 real and 0 generated"):
        render_guess_html([random_scene()], [], "title")
