"""Render a report as one self-contained HTML page with text, key figures, pictures, charts and tables.

The page contains its style, charts and pictures. The page uses no scripts and downloads nothing. The file can be
mailed, archived and opened offline. All inserted text is escaped.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

import numpy as np
from PIL import Image

from pipelines.reporting.chart import Chart, draw_chart_svg, format_number
from pipelines.reporting.report_style import STYLE

Cell = str | int | float | bool | None


@dataclass(frozen=True)
class Text:
    """Paragraphs of plain text."""

    title: str
    paragraphs: Sequence[str]


class Figure(NamedTuple):
    """One large number with its label and a remark."""

    value: Cell
    label: str
    note: str = ""


@dataclass(frozen=True)
class KeyFigures:
    """A row of large numbers."""

    title: str
    figures: Sequence[Figure]


class Picture(NamedTuple):
    """An image with its caption.

    Attributes:
        caption: Text below the image.
        image: (H, W, 3) uint8.
        tag: Short word on the image, such as "real" or "generated".
    """

    caption: str
    image: np.ndarray
    tag: str = ""


@dataclass(frozen=True, eq=False)
class Pictures:
    """A grid of pictures.

    Attributes:
        title: Heading.
        pictures: Pictures in reading order.
        columns: Number of pictures per row; narrow screens show fewer. None: as many pictures as fit.
        note: Text above the pictures.
    """

    title: str
    pictures: Sequence[Picture]
    columns: int | None = None
    note: str = ""


@dataclass(frozen=True, eq=False)
class Charts:
    """Line charts next to each other."""

    title: str
    charts: Sequence[Chart]
    note: str = ""


@dataclass(frozen=True)
class Table:
    """Table with column names.

    Numbers are shortened and right-aligned. Booleans are shown as a tick or a cross. None is shown as a dash.

    Attributes:
        title: Heading.
        columns: Column names.
        rows: Cells of each row.
        meanings: Explanation of each row. None: no explanations.
        note: Text above the table.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    meanings: Sequence[str] = ()
    note: str = ""


Section = Text | KeyFigures | Pictures | Charts | Table


def render_report_html(title: str, sections: Sequence[Section], subtitle: str = "") -> str:
    """Render the whole page; raise ValueError if the rows or meanings of a table do not match its columns."""
    anchors = [f"{index}-{re.sub('[^a-z0-9]+', '-', s.title.lower())}" for index, s in enumerate(sections, 1)]
    links = [f'<a href="#{a}">{escape(s.title)}</a>' for a, s in zip(anchors, sections, strict=True)]
    bodies = [
        f'<section id="{anchor}"><h2>{escape(section.title)}</h2>{_render_body(section)}</section>'
        for anchor, section in zip(anchors, sections, strict=True)
    ]
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>",
            f"<header><h1>{escape(title)}</h1>{_render_paragraph(subtitle)}<nav>{''.join(links)}</nav></header>",
            "<main>",
            *bodies,
            "</main></body></html>",
        ]
    )


def _render_body(section: Section) -> str:
    match section:
        case Text():
            return "".join(map(_render_paragraph, section.paragraphs))
        case KeyFigures():
            return f'<div class="figures">{"".join(map(_render_figure, section.figures))}</div>'
        case Pictures():
            return _render_paragraph(section.note) + _render_pictures(section)
        case Charts():
            return (
                f"{_render_paragraph(section.note)}<div "
                f'class="charts">{"".join(map(_render_chart, section.charts))}</div>'
            )
        case Table():
            return _render_paragraph(section.note) + _render_table(section)
    raise ValueError(f"not a section of a report: {section!r}")


def _render_paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>" if text else ""


def _render_figure(figure: Figure) -> str:
    note = f"<small>{escape(figure.note)}</small>" if figure.note else ""
    return f"<div><strong>{format_cell(figure.value)}</strong><span>{escape(figure.label)}</span>{note}</div>"


def _render_pictures(section: Pictures) -> str:
    style = f' style="--columns: {section.columns}"' if section.columns else ""
    kind = "pictures fixed" if section.columns else "pictures"
    return f'<div class="{kind}"{style}>{"".join(map(_render_picture, section.pictures))}</div>'


def _render_picture(picture: Picture) -> str:
    rows, cols = picture.image.shape[:2]
    size = f'width="{cols}" height="{rows}" loading="lazy"'
    tag = f'<span class="tag">{escape(picture.tag)}</span>' if picture.tag else ""
    image = f'<img src="{encode_data_uri(picture.image)}" {size} alt="{escape(picture.caption)}">'
    return f"<figure>{tag}{image}<figcaption>{escape(picture.caption)}</figcaption></figure>"


def encode_data_uri(image: np.ndarray) -> str:
    """Encode an image (H, W, 3) uint8 as a data URI: lossless PNG for at most 256 colours, otherwise lossy WebP."""
    picture, file = Image.fromarray(image), io.BytesIO()
    flat = picture.getcolors(256) is not None
    if flat:
        picture.save(file, "PNG", optimize=True)
    else:
        picture.save(file, "WEBP", quality=90, method=4)
    kind = "png" if flat else "webp"
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode()}"


def _render_chart(chart: Chart) -> str:
    return f"<figure>{draw_chart_svg(chart)}<figcaption>{escape(chart.title)}</figcaption></figure>"


def _render_table(table: Table) -> str:
    meanings = table.meanings or [None] * len(table.rows)
    if len(meanings) != len(table.rows):
        raise ValueError(f"table {table.title!r} has {len(table.rows)} rows and {len(meanings)} meanings")
    rows = []
    for row, meaning in zip(table.rows, meanings, strict=True):
        if len(row) != len(table.columns):
            raise ValueError(f"table {table.title!r} has {len(table.columns)} columns, but a row has {len(row)} cells")
        last = "" if meaning is None else f'<td class="meaning">{escape(meaning)}</td>'
        rows.append(f"<tr>{''.join(map(_render_cell, row))}{last}</tr>")
    numeric = [all(not isinstance(row[i], str) for row in table.rows) for i in range(len(table.columns))]
    head = "".join(map(_render_head, table.columns, numeric)) + ("<th>meaning</th>" if table.meanings else "")
    body = f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f'<div class="scroll"><table>{body}</table></div>'


def _render_head(name: str, numeric: bool) -> str:
    return f'<th class="number">{escape(name)}</th>' if numeric else f"<th>{escape(name)}</th>"


def _render_cell(value: Cell) -> str:
    if isinstance(value, str):
        return f"<td>{escape(value)}</td>"
    if isinstance(value, bool | np.bool):
        return f'<td class="number {"yes" if value else "no"}">{format_cell(value)}</td>'
    return f'<td class="number">{format_cell(value)}</td>'


def format_cell(value: Cell) -> str:
    """Format the value of a table cell for display."""
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool):
        return "✓" if value else "✗"
    return escape(value) if isinstance(value, str) else format_number(value)
