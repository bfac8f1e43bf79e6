"""References of growing size: which there are, and that more of them are what the paper's figure needs."""

import numpy as np
import pytest

from pipelines.selection import apart, farthest
from pipelines.sweep import references, sweep, sweep_charts, sweep_html


def test_references_fit_both_sides():
    rng = np.random.default_rng(0)
    xy, world = rng.uniform(0, 100, (200, 2)), np.zeros(200, int)
    got = list(references(xy, world, (10, 50, 150, 400), (30.0, 1.0, 1e-6), least=4, most=120))
    assert [(one.strategy, one.setting) for one in got][:2] == [("farthest", 10), ("farthest", 50)]
    assert [one.setting for one in got if one.strategy == "apart"] == [30.0]  # of 1 m there are more than 120
    assert np.array_equal(got[0].rows, farthest(xy, world, 10)) and np.array_equal(got[1].rows[:10], got[0].rows)
    assert np.array_equal(got[-1].rows, apart(xy, world, 30.0))


def test_a_row_per_reference_and_k(cluster):
    rng = np.random.default_rng(1)
    real, generated = rng.normal(size=(300, 8)), rng.normal(size=(300, 8))
    xy, labels = rng.uniform(0, 1000, (300, 2)), rng.choice(["low", "high"], 300)
    done = []
    chosen = list(references(xy, np.zeros(300, int), (20, 200), (), least=6, most=300))
    rows = sweep(real, generated, labels, chosen, (3, 5), lambda: done.append(1))
    assert [(row["samples"], row["k"]) for row in rows] == [(20, 3), (20, 5), (200, 3), (200, 5)]
    assert len(done) == 2 and all(0 < row["precision"] <= 1 for row in rows)
    assert all(a["precision"] <= b["precision"] for a, b in zip(rows[::2], rows[1::2], strict=True))  # larger balls
    assert sweep_charts(rows)[1].series["precision, k = 3"][0] == [20, 200]
    assert "farthest" in sweep_html(rows, ["how"])


def test_no_reference_that_fits_is_an_error():
    with pytest.raises(ValueError, match="no reference fits 5 real and 4 generated"):
        sweep(np.zeros((5, 2)), np.zeros((4, 2)), np.zeros(4), [], (3,))
