"""Tests of reports: each report is a well-formed page without external links."""

import base64
import io
import re

import numpy as np
import pytest
from helpers import Page
from PIL import Image

from pipelines.reporting.chart import Chart, choose_log_ticks, choose_ticks, draw_chart_svg, format_number
from pipelines.reporting.report import (
    Charts,
    Figure,
    KeyFigures,
    Picture,
    Pictures,
    Table,
    Text,
    render_report_html,
)


@pytest.fixture
def sections():
    rng = np.random.default_rng(0)
    flat = np.zeros((8, 8, 3), np.uint8)
    flat[:4] = [128, 64, 128]
    row, col = np.mgrid[:64, :64]
    shaded = np.stack([2 * row, 3 * col, row + col], axis=-1).astype(np.uint8)
    steps = np.arange(500)
    return [
        Text("Words", ["<script>alert(1)</script> & more"]),
        KeyFigures("Numbers", [Figure(1234567, "scenes", "of <b>town</b>"), Figure(None, "FID")]),
        Pictures("Pictures", [Picture("flat <i>", flat, "real"), Picture("shaded", shaded)], columns=2),
        Charts("Losses", [Chart("a < b", {"x & y": (steps, rng.random(500)), "few": ([0, 9], [1, 2])})]),
        Table("Scores", ["metric", "value", "ok"], [["IoU <", 0.51234, True], ["FID", None, False]], ["a", "b"]),
    ]


def test_report_page_is_well_formed_and_escaped(sections):
    page = Page(render_report_html("A & B <demo>", sections, "sub < title"))
    assert not page.all("script") and not page.all("link") and not page.all("i") and not page.all("b")
    for text in (
        "A & B <demo>",
        "sub < title",
        "<script>alert(1)</script> & more",
        "flat <i>",
        "x & y",
        "IoU <",
    ):
        assert text in page.text
    assert "1,234,567" in page.text and "0.5123" in page.text and "✓" in page.text and "✗" in page.text
    anchors = {attrs["id"] for attrs in page.all("section")}
    assert {attrs["href"][1:] for attrs in page.all("a")} == anchors and len(anchors) == len(sections)


def test_report_page_is_self_contained(sections):
    html = render_report_html("Demo", sections)
    assert not re.search(r"https?:|//[a-z]|@import", re.sub(r"base64,[A-Za-z0-9+/=]+", "", html))
    assert all(url.startswith("data:") for url in re.findall(r'src="([^"]+)"', html))


def test_report_keeps_pictures(sections):
    flat, shaded = (picture.image for picture in sections[2].pictures)
    sources = [attrs["src"] for attrs in Page(render_report_html("Demo", sections)).all("img")]
    assert sources[0].startswith("data:image/png;") and sources[1].startswith("data:image/webp;")
    decoded = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(source.split(",")[1]))).convert("RGB")) for source in sources
    ]
    assert np.array_equal(decoded[0], flat)  # the PNG keeps exact class colours
    assert decoded[1].shape == shaded.shape and np.abs(decoded[1].astype(int) - shaded).mean() < 4


def test_report_rejects_table_of_wrong_shape():
    with pytest.raises(ValueError, match="2 columns, but a row has 1"):
        render_report_html("Demo", [Table("T", ["a", "b"], [["x"]])])
    with pytest.raises(ValueError, match="1 rows and 2 meanings"):
        render_report_html("Demo", [Table("T", ["a"], [["x"]], ["one", "two"])])


def parse_polylines(svg):
    return [
        np.array([[float(v) for v in p.split(",")] for p in points.split()])
        for points in re.findall(r'points="([^"]*)"', svg)
    ]


def test_chart_draws_lines_at_values():
    (line,) = parse_polylines(draw_chart_svg(Chart("c", {"a": ([0, 1, 2], [0, 5, 10])})))
    assert np.allclose(np.diff(line, axis=0), np.diff(line, axis=0)[0], atol=0.11)
    assert (np.diff(line[:, 1]) < 0).all()
    (line,) = parse_polylines(draw_chart_svg(Chart("c", {"a": ([0, 1, 2], [1, 10, 100])}, log_y=True)))
    assert np.allclose(np.diff(line, axis=0), np.diff(line, axis=0)[0], atol=0.11)


def test_chart_omits_undrawable_values():
    chart = Chart("c", {"a": ([0, 1, 2, 3, 4], [1, np.nan, 0, -1, 10])}, log_y=True)
    (line,) = parse_polylines(draw_chart_svg(chart))
    assert len(line) == 2
    for series in ({}, {"a": ([], [])}, {"a": ([1.0], [np.inf])}):
        assert "no data" in draw_chart_svg(Chart("c", series))
    assert "<circle" in draw_chart_svg(Chart("c", {"a": ([3], [4])}))
    with pytest.raises(ValueError, match="same number of x and y values, got 2 and 1"):
        draw_chart_svg(Chart("c", {"a": ([1, 2], [1])}))


def test_chart_thins_and_smooths_long_series():
    y = np.sin(np.arange(10_000) / 2000)
    faint, mean = parse_polylines(draw_chart_svg(Chart("c", {"a": (np.arange(10_000), y)})))
    assert len(faint) <= 600 and len(mean) <= 600
    assert np.abs(faint - mean).max() < 6  # the running mean of a smooth series is close to the series


@pytest.mark.parametrize("low, high", [(0, 1), (-3, 17), (5, 5), (0, 0), (1e-7, 3e-7), (0.99, 123456)])
def test_ticks_enclose_data(low, high):
    values = choose_ticks(low, high)
    assert values[0] <= low and values[-1] >= high and 2 <= len(values) <= 8
    assert np.allclose(np.diff(values), values[1] - values[0])


@pytest.mark.parametrize("low, high", [(0.1, 10), (0.0023, 0.9), (3, 3), (1, 1), (1e-9, 1e6), (2.1, 3.9)])
def test_log_ticks_enclose_data(low, high):
    values = choose_log_ticks(low, high)
    assert values[0] <= low * (1 + 1e-9) and values[-1] >= high * (1 - 1e-9) and 2 <= len(values) <= 9


NUMBERS = {
    0: "0",
    0.51234: "0.5123",
    12.3456: "12.35",
    1234.5: "1,234",
    1234567: "1,234,567",
    2.5e-5: "2.5e-5",
    -0.25: "-0.25",
    3e12: "3e12",
    float("nan"): "–",
}


@pytest.mark.parametrize("value, written", NUMBERS.items())
def test_number_is_formatted_short(value, written):
    assert format_number(value) == written
