"""Draw charts of a dataset as inline SVG: histograms, size ranges, bars, label matrices and maps of drives.

The style of the page defines the colours of text, lines and series. The palette defines the colours of classes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from pipelines.reporting.chart import choose_log_ticks, choose_ticks, format_number
from pipelines.schema.palette import COLOR_HEX

MAX_BINS = 25
LEAST_SPAN = 10  # Minimum range of counts on the axis of a histogram. This minimum limits the width of the bars.
PAGE_PX = 1140  # Width of a drawing that fills the page.


def spell_name(name: str) -> str:
    """Return the name of a category or class with spaces instead of underscores."""
    return name.replace("_", " ")


def _make_svg(title: str, width: float, height: float, parts: Sequence[str], min_width: int = 0) -> str:
    style = f' style="min-width:{min_width}px"' if min_width else ""
    head = f'<svg class="chart" viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(title)}"{style}>'
    return "".join([head, *parts, "</svg>"])


def _draw_text(x: float, y: float, text: str, anchor: str = "start", ink: bool = False, bold: bool = False) -> str:
    style = f"text-anchor:{anchor}" + (";fill:var(--ink)" if ink else "") + (";font-weight:600" if bold else "")
    return f'<text x="{x:.1f}" y="{y:.1f}" style="{style}">{escape(text)}</text>'


def _draw_line(x1: float, y1: float, x2: float, y2: float, kind: str, extra: str = "") -> str:
    return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" {extra}/>'


def _draw_rect(x: float, y: float, width: float, height: float, extra: str, title: str = "") -> str:
    place = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"'
    return f"<rect {place} {extra}><title>{escape(title)}</title></rect>" if title else f"<rect {place} {extra}/>"


def _draw_swatch(x: float, y: float, name: str) -> str:
    return _draw_rect(x, y - 11, 12, 12, f'rx="2" fill="#{COLOR_HEX[name]}" stroke="var(--line)"')


# --------------------------------------------------------------------------------------------------- histograms


def count_bins(counts: np.ndarray) -> tuple[int, np.ndarray]:
    """Count values in bins of equal width.

    Args:
        counts: (n,) whole numbers, at least 0.

    Returns:
        Width of the bins, and the number of values per bin. The first bin starts at 0.
    """
    width = int(counts.max(initial=0)) // MAX_BINS + 1
    return width, np.bincount(counts.astype(int) // width)


def draw_count_histogram(category: str, counts: np.ndarray, marks: Mapping[str, float]) -> str:
    """Draw a histogram of the number of primitives of a category per scene.

    Args:
        category: Category.
        counts: (n,) number of primitives of the category in each scene.
        marks: Counts that are marked by a line (dictionary from name to count).

    Returns:
        <svg> element.
    """
    width, height, left, right, top, bottom = 300, 190, 40, 12, 44, 24
    bin_width, scenes = count_bins(counts)
    beyond = max([LEAST_SPAN, len(scenes) * bin_width, *(value + 1 for value in marks.values())])
    step_px = (width - left - right) / beyond
    y_ticks = choose_ticks(0, int(scenes.max(initial=1)), 3)

    def y_px(value: float) -> float:
        return height - bottom - value / y_ticks[-1] * (height - bottom - top)

    parts = [_draw_swatch(0, 14, category), _draw_text(18, 14, spell_name(category), ink=True, bold=True)]
    for value in y_ticks:
        parts.append(_draw_line(left, y_px(value), width - right, y_px(value), "grid"))
        parts.append(_draw_text(left - 6, y_px(value) + 4, format_number(value), "end"))
    for k, value in enumerate(scenes):
        if value:
            first, last = k * bin_width, (k + 1) * bin_width - 1
            span = f"{first}" if first == last else f"{first} to {last}"
            box = left + first * step_px + 0.5, y_px(value), bin_width * step_px - 1, height - bottom - y_px(value)
            parts.append(_draw_rect(*box, 'class="series-0"', f"{span}: {value} scenes"))
    for value in choose_ticks(0, beyond, 4):
        if value <= beyond - 0.5 and value == int(value):
            parts.append(_draw_text(left + (value + 0.5) * step_px, height - 6, format_number(value), "middle"))
    parts.append(_draw_line(left, height - bottom, width - right, height - bottom, "axis"))
    for value, names in _join_mark_names(marks).items():
        x = left + (value + 0.5) * step_px
        parts.append(
            _draw_line(x, top - 6, x, height - bottom, "series-3", 'stroke-width="1.5" stroke-dasharray="4 3"')
        )
        past = x > (left + width) / 2
        parts.append(
            _draw_text(x + (3 if past else -3), top - 11, f"{names} {format_number(value)}", "end" if past else "start")
        )
    return _make_svg(f"scenes by number of {spell_name(category)}", width, height, parts)


def _join_mark_names(marks: Mapping[str, float]) -> dict[float, str]:
    """Map each value to the joined names of the marks that have this value."""
    names: dict[float, list[str]] = {}
    for name, value in marks.items():
        names.setdefault(value, []).append(name)
    return {value: " = ".join(found) for value, found in names.items()}


# -------------------------------------------------------------------------------------------------------- sizes


def draw_size_ranges(percentiles_m: Mapping[str, np.ndarray]) -> str:
    """Draw the ranges of length, width and height of each category on one logarithmic axis.

    A thin line extends from the 5th to the 95th percentile. A thick line extends from the 25th to the 75th percentile.
    A dot marks the median.

    Args:
        percentiles_m: (5, 3) array per category: rows are the 5th, 25th, 50th, 75th and 95th percentile; columns are
            length, width and height (m).

    Returns:
        <svg> element.
    """
    left, right, top, bottom, row, group = 190, 30, 34, 28, 13, 50
    height = top + group * len(percentiles_m) + bottom
    everything = np.concatenate([np.ravel(v) for v in percentiles_m.values()]).clip(0.01)
    axis = choose_log_ticks(everything.min(), everything.max())
    low, high = np.log10(axis[0]), np.log10(axis[-1])

    def x_px(value: float) -> float:
        return left + (np.log10(max(value, 0.01)) - low) / (high - low) * (PAGE_PX - left - right)

    parts = []
    for k, name in enumerate(("length", "width", "height")):
        parts += [
            _draw_rect(left + 90 * k, 4, 12, 12, f'rx="2" class="series-{k}"'),
            _draw_text(left + 90 * k + 18, 15, name),
        ]
    for value in axis:
        parts.append(_draw_line(x_px(value), top, x_px(value), height - bottom, "grid"))
        parts.append(_draw_text(x_px(value), height - 8, f"{format_number(value)} m", "middle"))
    for k, (category, values) in enumerate(percentiles_m.items()):
        y0 = top + group * k
        parts += [
            _draw_swatch(0, y0 + group / 2 + 5, category),
            _draw_text(18, y0 + group / 2 + 5, spell_name(category), ink=True),
        ]
        parts.append(_draw_line(0, y0, PAGE_PX - right, y0, "grid"))
        for axis_index, (p05, p25, p50, p75, p95) in enumerate(np.asarray(values).T):
            y, kind = y0 + group / 2 + row * (axis_index - 1), f"series-{axis_index}"
            parts.append(_draw_line(x_px(p05), y, x_px(p95), y, kind, 'stroke-width="1.5" stroke-linecap="round"'))
            parts.append(_draw_line(x_px(p25), y, x_px(p75), y, kind, 'stroke-width="5" stroke-linecap="round"'))
            dot = f'cx="{x_px(p50):.1f}" cy="{y:.1f}" r="3.4" fill="var(--card)" stroke-width="2"'
            parts.append(f'<circle style="fill:var(--card)" class="{kind}" {dot}/>')
    parts.append(_draw_line(left, height - bottom, PAGE_PX - right, height - bottom, "axis"))
    return _make_svg("sizes by category", PAGE_PX, height, parts, min_width=760)


# ------------------------------------------------------------------------------------------------ shares, labels


def draw_share_bars(title: str, shares: Mapping[str, Mapping[str, float]]) -> str:
    """Draw shares as bars in class colours.

    Args:
        title: Title.
        shares: Shares in [0, 1], for each ground class and label.

    Returns:
        <svg> element.
    """
    width, left, right, top, row, gap = 560, 180, 62, 30, 20, 12
    rows = sum(len(by_label) for by_label in shares.values())
    largest = max((value for by_label in shares.values() for value in by_label.values()), default=0) or 1
    parts, y = [_draw_text(0, 14, title, ink=True, bold=True)], float(top)
    for name, by_label in shares.items():
        parts += [_draw_swatch(0, y + 15, name), _draw_text(18, y + 15, spell_name(name), ink=True)]
        for label, value in by_label.items():
            long = value / largest * (width - left - right)
            parts.append(_draw_text(left - 10, y + 15, label, "end"))
            parts.append(
                _draw_rect(left, y + 3, max(long, 1), row - 6, f'rx="2" fill="#{COLOR_HEX[name]}" stroke="var(--line)"')
            )
            parts.append(_draw_text(left + long + 8, y + 15, f"{100 * value:.1f} %", ink=True))
            y += row
        y += gap
    return _make_svg(title, width, top + rows * row + gap * len(shares), parts)


def draw_label_matrix(title: str, counts: np.ndarray, rows: Sequence[str], columns: Sequence[str]) -> str:
    """Draw the number of scenes for each pair of labels as shaded cells.

    Args:
        title: Title.
        counts: (rows, columns) number of scenes.
        rows: Names of the rows.
        columns: Names of the columns.

    Returns:
        <svg> element.
    """
    left, top, wide, tall = 80, 74, 66, 46
    total, largest = max(int(counts.sum()), 1), max(int(counts.max(initial=0)), 1)
    width, height = left + wide * len(columns) + 4, top + tall * len(rows) + 4
    parts = [
        _draw_text(0, 14, title, ink=True, bold=True),
        _draw_text(left, 40, "vehicles"),
        _draw_text(0, 64, "vegetation"),
    ]
    parts += [_draw_text(left + wide * (k + 0.5), 64, name, "middle", ink=True) for k, name in enumerate(columns)]
    for j, row in enumerate(rows):
        parts.append(_draw_text(left - 10, top + tall * (j + 0.5) + 5, row, "end", ink=True))
        for k, column in enumerate(columns):
            x, y, count = left + wide * k, top + tall * j, int(counts[j, k])
            opacity = 0.04 + 0.5 * count / largest
            shade = f'rx="4" class="series-0" style="stroke:none" fill-opacity="{opacity:.2f}"'
            parts.append(_draw_rect(x + 2, y + 2, wide - 4, tall - 4, shade, f"{row}, {column}: {count} scenes"))
            parts.append(
                _draw_text(x + wide / 2, y + (21 if count else 28), format_number(count), "middle", ink=count > 0)
            )
            if count:
                parts.append(_draw_text(x + wide / 2, y + 37, f"{100 * count / total:.0f} %", "middle", ink=True))
    return _make_svg(title, width, height, parts)


# --------------------------------------------------------------------------------------------------------- map

SPLIT_STYLE = {"unused": "axis", "train": "series-1", "test": "series-3"}  # Styles; splits are drawn in this order.
MAX_NAMED = 60  # With more sequences, the frames are too small for names.


class _Shelf(NamedTuple):
    """Sizes for the arrangement of the maps of sequences in rows (px).

    Attributes:
        least: Minimum width of the map of one sequence (px).
        below: Height of the space below the map of one sequence (px).
        gap: Space between the maps of two sequences (px).
        cell: Maximum height of the map of one sequence (px).
        total: Maximum combined height of all rows (px).
    """

    least: int
    below: int
    gap: int
    cell: int
    total: int


NAMED, NAMELESS = _Shelf(72, 24, 30, 320, 640), _Shelf(4, 0, 14, 320, 2000)
PADDING_PX, LEGEND_PX = 7, 34


def draw_track_map(positions_m: Mapping[str, Mapping[str, np.ndarray]]) -> str:
    """Draw a map of the scenes of each sequence, all at the same scale, with x to the right and y upwards.

    Each scene is a dot. Each sequence has a frame, and the frames are arranged in rows.

    Args:
        positions_m: (n, 2) x and y of the scenes of each sequence and split (m, world frame).

    Returns:
        <svg> element.
    """
    everything = [np.concatenate(list(by_split.values())) for by_split in positions_m.values()]
    middle_m = np.array([(xy.max(axis=0) + xy.min(axis=0)) / 2 for xy in everything])
    extent_m = np.array([np.ptp(xy, axis=0) for xy in everything])
    shelf = NAMED if len(everything) <= MAX_NAMED else NAMELESS
    px_per_m = _draw_scale(extent_m, shelf)
    cells_px = np.maximum(extent_m * px_per_m, [[shelf.least, 0]])
    corners_px, height = _pack_shelves(cells_px, shelf)
    corners_px[:, 1] += LEGEND_PX

    parts, dots = _draw_map_legend(positions_m, px_per_m), {}
    for k, (sequence, by_split) in enumerate(positions_m.items()):
        parts += _draw_frame(sequence, len(everything[k]), corners_px[k], cells_px[k], shelf)
        for split, xy in by_split.items():
            at = (xy - middle_m[k]) * px_per_m * [1, -1] + corners_px[k] + cells_px[k] / 2
            dots.setdefault(split, []).extend(f"M{x:.1f} {y:.1f}h0" for x, y in at)
    sparse = sum(map(len, everything)) < 40 * len(everything)
    style = f'fill="none" stroke-width="{4.5 if sparse else 3}" stroke-linecap="round"'
    for split in sorted(dots, key=_draw_order):
        kind = SPLIT_STYLE.get(split, "series-0")
        parts.append(f'<path class="{kind}" {style} data-split="{escape(split)}" d="{"".join(dots[split])}"/>')
    return _make_svg("positions of the scenes", PAGE_PX, LEGEND_PX + height, parts, min_width=760)


def _draw_order(split: str) -> tuple[int, str]:
    return (list(SPLIT_STYLE).index(split) if split in SPLIT_STYLE else len(SPLIT_STYLE), split)


def _draw_frame(sequence: str, scenes: int, corner_px: np.ndarray, cell_px: np.ndarray, shelf: _Shelf) -> list[str]:
    """Draw the frame of a sequence, and its name below the frame if there is enough space."""
    x, y = corner_px - PADDING_PX
    outline = 'rx="6" fill="none" stroke="var(--line)"'
    width, height = cell_px + 2 * PADDING_PX
    parts = [_draw_rect(x, y, width, height, outline, f"{sequence}: {scenes} scenes")]
    if shelf is NAMED:
        name = sequence if len(sequence) <= 9 else f"{sequence[:8]}…"
        parts.append(_draw_text(x, y + cell_px[1] + 2 * PADDING_PX + 15, name))
    return parts


def _draw_map_legend(positions_m: Mapping[str, Mapping[str, np.ndarray]], px_per_m: float) -> list[str]:
    """Draw the legend of the splits with their numbers of scenes, and a scale bar with a round number of metres."""
    found: Counter = Counter()
    for by_split in positions_m.values():
        found.update({split: len(xy) for split, xy in by_split.items()})
    parts, x = [], 5.0
    for split in ("train", "test", *sorted(found.keys() - {"train", "test"})):
        if found[split]:
            words = f"{split} {format_number(found[split])}"
            kind, style = SPLIT_STYLE.get(split, "series-0"), 'stroke-width="9" stroke-linecap="round"'
            parts += [_draw_line(x, 12, x, 12, kind, style), _draw_text(x + 11, 16.5, words, ink=True)]
            x += 34 + 7.2 * len(words)
    bar_m = max(v for v in (m * 10.0**k for k in range(-2, 8) for m in (1, 2, 5)) if v * px_per_m <= 160)
    left, right = PAGE_PX - 1 - bar_m * px_per_m, PAGE_PX - 1
    parts += [
        _draw_line(left, 12, right, 12, "axis"),
        _draw_line(left, 8, left, 16, "axis"),
        _draw_line(right, 8, right, 16, "axis"),
    ]
    return [*parts, _draw_text(left - 9, 16.5, f"{format_number(bar_m)} m", "end", ink=True)]


def _draw_scale(extent_m: np.ndarray, shelf: _Shelf) -> float:
    """Return the largest scale (px / m) at which each sequence fits into its cell and all cells fit into the map."""
    low, high = 1e-6, 20.0
    for _ in range(40):
        middle = (low * high) ** 0.5
        cells = np.maximum(extent_m * middle, [[shelf.least, 0]])
        fits = cells[:, 0].max() <= PAGE_PX - 2 * PADDING_PX - 2 and cells[:, 1].max() <= shelf.cell
        fits = fits and _pack_shelves(cells, shelf)[1] <= shelf.total
        low, high = (middle, high) if fits else (low, middle)
    return low


def _pack_shelves(cells_px: np.ndarray, shelf: _Shelf) -> tuple[np.ndarray, float]:
    """Arrange cells of sizes (n, 2) in bottom-aligned rows; return their top left corners (n, 2) and the total
    height."""
    places, rows, x = np.zeros_like(cells_px), [[]], PADDING_PX + 1.0
    for k, (width, _) in enumerate(cells_px):
        if rows[-1] and x + width > PAGE_PX - PADDING_PX - 1:
            rows.append([])
            x = PADDING_PX + 1.0
        rows[-1].append(k)
        places[k, 0] = x
        x += width + shelf.gap
    y = float(PADDING_PX)
    for row in rows:
        tall = cells_px[row, 1].max()
        places[row, 1] = y + tall - cells_px[row, 1]
        y += tall + shelf.below + shelf.gap
    return places, y - shelf.gap + PADDING_PX
