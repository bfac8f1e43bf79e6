"""Draw line charts as inline SVG with axes, ticks and a legend. Colours come from the style of the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

from pipelines.reporting.report_style import STYLE

WIDTH, HEIGHT = 640, 360
LEFT, RIGHT, TOP, BOTTOM = 64, 16, 16, 46  # Margins around the axes.
MAX_POINTS = 600
NUM_COLORS = 6  # The style defines the classes series-0 to series-5.


@dataclass(frozen=True, eq=False)
class Chart:
    """Line chart of named series (x, y).

    Values that are not finite are skipped. On a logarithmic axis, values that are not positive are skipped too. A
    series with at least 200 points is drawn in a faint colour, and its moving average is drawn over it.
    """

    title: str
    series: Mapping[str, tuple[Sequence[float] | np.ndarray, Sequence[float] | np.ndarray]]
    x_label: str = ""
    y_label: str = ""
    log_y: bool = False


def draw_chart_svg(chart: Chart) -> str:
    """Draw the chart as an <svg> element. Raises ValueError if x and y of a series differ in length."""
    series = {name: _find_drawable(x, y, chart.log_y) for name, (x, y) in chart.series.items()}
    points = [np.stack(pair) for pair in series.values() if len(pair[0])]
    head = f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(chart.title)}">'
    if not points:
        return f'{head}<text class="empty" x="{WIDTH / 2}" y="{HEIGHT / 2}">no data</text></svg>'
    low, high = np.hstack(points).min(axis=1), np.hstack(points).max(axis=1)
    x_ticks, y_ticks = (
        choose_ticks(low[0], high[0]),
        (choose_log_ticks if chart.log_y else choose_ticks)(low[1], high[1]),
    )
    x_axis = _Axis(low[0], high[0], LEFT, WIDTH - RIGHT)
    y_axis = _Axis(y_ticks[0], y_ticks[-1], HEIGHT - BOTTOM, TOP, chart.log_y)
    parts = [head, *_draw_grid(x_axis, y_axis, x_ticks, y_ticks), *_draw_labels(chart)]
    for index, (x, y) in enumerate(series.values()):
        parts += _draw_lines(x_axis(x), y_axis(y), index % NUM_COLORS)
    return "".join([*parts, _draw_legend(list(series)), "</svg>"])


def make_standalone_svg(chart: Chart) -> str:
    """Make a standalone SVG file of the chart, with the XML namespace and the style of the page."""
    face = 'svg { font-family: system-ui, "Liberation Sans", sans-serif; background: var(--card); }'
    head, rest = draw_chart_svg(chart).split(">", 1)
    space = head.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)
    return f"{space}><style><![CDATA[{STYLE}{face}]]></style>{rest}"


def choose_ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Choose evenly spaced round numbers that cover [low, high]; the step is 1, 2 or 5 times a power of ten."""
    if high <= low:
        high = low + max(abs(low), 1.0)
    raw = (high - low) / about
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(k * step, 12) for k in range(first, last + 1)]


def choose_log_ticks(low: float, high: float) -> list[float]:
    """Choose powers of ten around [low, high]. If the powers span at most two decades, also return 2 times and 5 times
    each power."""
    first = math.floor(math.log10(low) + 1e-9)
    last = max(first + 1, math.ceil(math.log10(high) - 1e-9))
    factors, every = (1, 2, 5) if last - first <= 2 else (1,), math.ceil((last - first) / 6)
    values = [m * 10.0**k for k in range(first, last + every, every) for m in factors]
    start = max(i for i, v in enumerate(values) if v <= low * (1 + 1e-9))
    stop = min(i for i, v in enumerate(values) if v >= high * (1 - 1e-9) and i > start)
    return values[start : stop + 1]


@dataclass(frozen=True)
class _Axis:
    """Mapping from values to pixels."""

    low: float
    high: float
    start_px: float
    end_px: float
    log: bool = False

    def __call__(self, value: np.ndarray | float) -> Any:
        scale = np.log10 if self.log else np.asarray
        value, low, high = scale(value), scale(self.low), scale(self.high)
        share = (value - low) / (high - low) if high > low else np.full_like(value, 0.5)
        return self.start_px + share * (self.end_px - self.start_px)


def _find_drawable(
    x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray, log_y: bool
) -> tuple[np.ndarray, np.ndarray]:
    xs, ys = np.asarray(x, float), np.asarray(y, float)
    if xs.shape != ys.shape:
        raise ValueError(f"a series must have the same number of x and y values, got {xs.size} and {ys.size}")
    keep = np.isfinite(xs) & np.isfinite(ys)
    if log_y:
        keep &= ys > 0
    return xs[keep], ys[keep]


def _draw_grid(x_axis: _Axis, y_axis: _Axis, x_ticks: list[float], y_ticks: list[float]) -> list[str]:
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    parts = []
    for value in y_ticks:
        y = float(y_axis(value))
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="tick y" x="{LEFT - 8}" y="{y + 4:.1f}">{format_number(value)}</text>')
    for value in x_ticks:
        if x_axis.low <= value <= x_axis.high:
            x = float(x_axis(value))
            parts.append(f'<line class="axis" x1="{x:.1f}" x2="{x:.1f}" y1="{bottom}" y2="{bottom + 5}"/>')
            parts.append(f'<text class="tick x" x="{x:.1f}" y="{bottom + 19}">{format_number(value)}</text>')
    return [*parts, f'<line class="axis" x1="{LEFT}" x2="{right}" y1="{bottom}" y2="{bottom}"/>']


def _draw_labels(chart: Chart) -> list[str]:
    x, y = (LEFT + WIDTH - RIGHT) / 2, (TOP + HEIGHT - BOTTOM) / 2
    turned = f'transform="rotate(-90 14 {y})"'
    return [
        f'<text class="label" x="{x}" y="{HEIGHT - 6}">{escape(chart.x_label)}</text>',
        f'<text class="label" x="14" y="{y}" {turned}>{escape(chart.y_label)}</text>',
    ]


def _draw_lines(x: np.ndarray, y: np.ndarray, color: int) -> list[str]:
    if len(x) == 1:
        return [f'<circle class="series-{color}" cx="{x[0]:.1f}" cy="{y[0]:.1f}" r="3"/>']
    if len(x) < 200:
        return [_draw_polyline(x, y, f"series-{color}")]
    window = len(x) // 40
    mean = np.convolve(np.pad(y, window // 2, "edge"), np.full(window, 1 / window), "same")
    mean = mean[window // 2 :][: len(x)]
    return [_draw_polyline(x, y, f"series-{color} faint"), _draw_polyline(x, mean, f"series-{color}")]


def _draw_polyline(x: np.ndarray, y: np.ndarray, style: str) -> str:
    at = np.unique(np.linspace(0, len(x) - 1, min(len(x), MAX_POINTS)).round().astype(int))
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x[at], y[at], strict=True))
    return f'<polyline class="{style}" points="{points}"/>'


def _draw_legend(names: list[str]) -> str:
    parts = []
    for index, name in enumerate(names if len(names) > 1 else []):
        y = TOP + 14 + 18 * index
        swatch = f'<rect class="series-{index % NUM_COLORS}" x="{WIDTH - RIGHT - 14}" y="{y - 8}" '
        parts.append(f'{swatch}width="12" height="4" rx="2"/>')
        parts.append(f'<text class="legend" x="{WIDTH - RIGHT - 20}" y="{y - 2}">{escape(name)}</text>')
    return "".join(parts)


def format_number(value: float) -> str:
    """Format a number for a chart or a table.

    Numbers of at least 1000 are rounded to integers and have thousands separators. Very large and very small numbers
    have an exponent. Other numbers have at most four significant digits.
    """
    if not math.isfinite(value):
        return "–"
    size = abs(value)
    if size >= 1e9 or 0 < size < 1e-3:
        mantissa, exponent = f"{value:.2e}".split("e")
        mantissa = mantissa.rstrip("0").rstrip(".")
        return f"{mantissa}e{int(exponent)}"
    if size >= 1000 or value == int(value):
        return f"{round(value):,}"
    return f"{value:.4g}"
