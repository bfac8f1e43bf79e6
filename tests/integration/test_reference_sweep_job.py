"""Tests of the sweep over reference sets and numbers of neighbours, on Ray."""

import numpy as np

from pipelines.evaluation.reference_sweep import draw_sweep_charts, list_references, render_sweep_html, sweep_references


def test_reference_sweep_has_row_per_reference_and_k(cluster):
    rng = np.random.default_rng(1)
    real, generated = rng.normal(size=(300, 8)), rng.normal(size=(300, 8))
    xy, labels = rng.uniform(0, 1000, (300, 2)), rng.choice(["low", "high"], 300)
    done = []
    chosen = list(list_references(xy, np.zeros(300, int), (20, 200), (), least=6, most=300))
    rows = sweep_references(real, generated, labels, chosen, (3, 5), lambda: done.append(1))
    assert [(row["samples"], row["k"]) for row in rows] == [(20, 3), (20, 5), (200, 3), (200, 5)]
    assert len(done) == 2 and all(0 < row["precision"] <= 1 for row in rows)
    assert all(
        a["precision"] <= b["precision"] for a, b in zip(rows[::2], rows[1::2], strict=True)
    )  # a larger k gives larger balls
    assert draw_sweep_charts(rows)[1].series["precision, k = 3"][0] == [20, 200]
    assert "farthest" in render_sweep_html(rows, ["how"])
