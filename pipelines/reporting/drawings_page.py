"""Render a report page that contains sections with SVG drawings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

from pipelines.reporting.report import Section, Text, render_report_html


class CaptionedSvg(NamedTuple):
    """An <svg> element and its caption."""

    svg: str
    caption: str = ""


@dataclass(frozen=True)
class DrawingsSection:
    """A section of drawings.

    Attributes:
        title: Heading.
        drawings: Drawings in reading order.
        layout: `wide`: one drawing per row. `pairs`: two drawings per row. `small`: many drawings per row.
        note: Text above the drawings.
    """

    title: str
    drawings: Sequence[CaptionedSvg]
    layout: str
    note: str = ""


def render_page_html(title: str, sections: Sequence[Section | DrawingsSection], subtitle: str = "") -> str:
    """Render a page like `render_report_html`, but allow sections with drawings."""
    plain = [
        Text(section.title, [section.note, _make_marker(index)]) if isinstance(section, DrawingsSection) else section
        for index, section in enumerate(sections)
    ]
    html = render_report_html(title, plain, subtitle)
    for index, section in enumerate(sections):
        if isinstance(section, DrawingsSection):
            html = html.replace(f"<p>{_make_marker(index)}</p>", _render_drawings(section))
    return html


def _make_marker(index: int) -> str:
    return f"[drawings of section {index}]"


def _render_drawings(section: DrawingsSection) -> str:
    kind = {"wide": "scroll", "pairs": "charts", "small": "pictures"}[section.layout]
    captions = [f"<figcaption>{escape(d.caption)}</figcaption>" if d.caption else "" for d in section.drawings]
    figures = [f"<figure>{d.svg}{caption}</figure>" for d, caption in zip(section.drawings, captions, strict=True)]
    return f'<div class="{kind}">{"".join(figures)}</div>'
