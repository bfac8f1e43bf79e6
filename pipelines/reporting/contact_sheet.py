"""Draw scenes of a dataset directory: a plate shows one scene in all views, and a sheet shows many scenes.

The functions accept real and generated scenes. Only `paint_scene` uses Ray.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from typing import Literal, NamedTuple, cast

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from models.scene import CATEGORIES, ELLIPSOID, Scene
from pipelines.io.mesh_export import compute_placements
from pipelines.rendering.render import arrange_contact_sheet, average_blocks, render_3d, render_bev
from pipelines.reporting.chart import choose_ticks, format_number
from pipelines.reporting.dataset_charts import spell_name
from pipelines.reporting.scene_index import Catalogue
from pipelines.schema.palette import COLOR_HEX, parse_rgb
from pipelines.schema.tables import Shard

CHUNK = 4  # Scenes per Ray task.

INK, SOFT, LINE = "#1b2130", "#5d6675", "#d5dae2"


# -------------------------------------------------------------------------------------------- pictures, by Ray


@dataclass(frozen=True)
class View:
    """Kind and size of a picture of a scene.

    Attributes:
        kind: `bev` is a view from above; `3d` is an oblique view.
        size_px: If `kind` is `bev`, the length of the longer side (px). If `kind` is `3d`, the width (px) of a picture
            with the aspect ratio 4 : 3.
    """

    kind: Literal["bev", "3d"]
    size_px: int

    def picture(self, scene: Scene) -> np.ndarray:
        """Render a scene as (H, W, 3) uint8."""
        if self.kind == "bev":
            return render_bev(scene, self.size_px, supersample=2)
        return render_3d(scene, self.size_px, 3 * self.size_px // 4)


def paint_scenes(row: dict, views: tuple[View, ...]) -> list[tuple[int, int, np.ndarray]]:
    """Render the scenes that an input row lists.

    Args:
        row: Dictionary with a shard, rows of the shard, and the positions of the scenes in the result.
        views: Views to render.

    Returns:
        For each picture, the position of its scene in the result, the index of the view, and (H, W, 3) uint8.
    """
    shard = Shard(row["root"], row["source"], row["split"], row["number"])
    out = []
    for place, scene in zip(row["places"], shard.scenes(list(row["rows"])), strict=True):
        for view, kind in enumerate(views):
            out.append((place, view, kind.picture(scene)))
    return out


def paint_scene(
    catalogue: Catalogue, indices: np.ndarray, views: tuple[View, ...], on_picture: Callable[[], None] | None = None
) -> list[list[np.ndarray]]:
    """Render selected scenes with Ray; a task renders up to CHUNK scenes of one shard.

    Args:
        catalogue: Scenes of a dataset directory.
        indices: Indices of the scenes.
        views: Views to render.
        on_picture: Called after each picture.

    Returns:
        One list per scene, with one picture per view.
    """
    from pipelines.runtime.ray_tasks import map_tasks

    tasks = [
        {**asdict(shard), "rows": rows, "places": places} for shard, rows, places in catalogue.chunks(indices, CHUNK)
    ]

    def paint_chunk(row: dict) -> list[tuple[int, int, np.ndarray]]:
        return paint_scenes(row, views)

    pictures: list[list] = [[None] * len(views) for _ in indices]
    for place, view, picture in chain.from_iterable(map_tasks(paint_chunk, tasks)):
        pictures[place][view] = picture
        if on_picture:
            on_picture()
    return pictures


# ------------------------------------------------------------------------------------------------- parts of plates


def load_font(size: int) -> ImageFont.FreeTypeFont:
    """Load the font that Pillow contains; text then looks the same on all machines."""
    # Pillow returns a scalable font, because a size is given.
    return cast(ImageFont.FreeTypeFont, ImageFont.load_default(size=size))


def fit_text(text: str, size: int, width_px: float) -> str:
    """Return the text; text wider than `width_px` is shortened in the middle."""
    face, shown = load_font(size), text
    for kept in range(len(text) - 1, 3, -1):
        if face.getlength(shown) <= width_px:
            break
        shown = f"{text[: kept // 2]}...{text[len(text) - kept + kept // 2 :]}"
    return shown


def write_text(draw: ImageDraw.ImageDraw, x: float, y: float, text: str, size: int = 18, fill: str = SOFT) -> float:
    """Write text to the right of x, vertically centred on y, and return the x position of its end.

    The font lacks ² and ³, so the function draws them as small raised digits.
    """
    for k, part in enumerate(re.split("([²³])", text)):
        raised = k % 2 == 1
        face, part = load_font(round(0.65 * size) if raised else size), part.translate({ord("²"): "2", ord("³"): "3"})
        draw.text((x, y - (0.32 * size if raised else 0)), part, fill, face, anchor="lm")
        x += face.getlength(part)
    return x


def draw_swatch(draw: ImageDraw.ImageDraw, x: float, y: float, name: str, size: int = 16) -> None:
    """Draw a square in the colour of a ground class or category, vertically centred on y."""
    draw.rectangle((x, y - size / 2, x + size, y + size / 2), fill=parse_rgb(COLOR_HEX[name]), outline=LINE)


# ------------------------------------------------------------------------------------------- one scene, every view

# Evenly spaced colours of the viridis map.
RAMP = np.array(
    [
        parse_rgb(c)
        for c in ("440154", "482878", "3e4989", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725")
    ]
)


def draw_heights(scene: Scene, size_px: int) -> tuple[np.ndarray, tuple[float, float]]:
    """Draw the height of the fused ground in the colours of RAMP; pixels without ground are white.

    The colours range from the 1st to the 99th percentile of the heights, because outliers would reduce the contrast.

    Args:
        scene: Scene.
        size_px: Length of the longer side (px).

    Returns:
        (H, W, 3) uint8 picture, and the lowest and highest height of the colour ramp (m). Without ground, the heights
        are (0, 1).
    """
    surface, winner = scene.surface()
    known = winner >= 0
    low, high = np.percentile(surface[known], [1, 99]) if known.any() else (0.0, 1.0)
    high = max(high, low + 0.01)
    colored = np.where(known[..., None], make_color_ramp((surface - low) / (high - low)), 255)
    scale = size_px / max(known.shape)
    row, col = (((np.arange(2 * round(n * scale)) + 0.5) / (2 * scale)).astype(int).clip(0, n - 1) for n in known.shape)
    return np.round(average_blocks(colored[np.ix_(row, col)], 2)).astype(np.uint8), (float(low), float(high))


def make_color_ramp(share: np.ndarray) -> np.ndarray:
    """Return the float sRGB colours (..., 3) of values (...), which are clipped to [0, 1]."""
    share = np.clip(share, 0, 1) * (len(RAMP) - 1)
    return np.stack([np.interp(share, np.arange(len(RAMP)), channel) for channel in RAMP.T], axis=-1)


def compute_footprints_m(scene: Scene) -> list[np.ndarray]:
    """Compute the outline (k, 2) of each primitive as seen from above (m, scene frame)."""
    transform = compute_placements(scene)
    outlines = []
    turn = np.linspace(0, 2 * np.pi, 33)[:-1]
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1) / 2
    for axes, center, category in zip(transform[:, :2, :3], transform[:, :2, 3], scene.category, strict=True):
        if category == ELLIPSOID:  # The outline is the boundary of the points axes @ s with |s| = 1/2.
            outlines.append(center + circle @ np.linalg.cholesky(axes @ axes.T).T)
            continue
        edges = axes.T * np.where(axes[1] < 0, -1, 1)[:, None]
        edges = edges[np.arctan2(edges[:, 1], edges[:, 0]).argsort()]
        path = np.concatenate([edges, -edges]).cumsum(axis=0)
        outlines.append(center - edges.sum(axis=0) / 2 + path)
    return outlines


def draw_footprints(scene: Scene, size_px: int, supersample: int = 3) -> np.ndarray:
    """Draw transparent footprints of the primitives, seen from above; higher primitives cover lower primitives.

    A line from the centre shows the heading of a primitive if it is known.

    Args:
        scene: Scene.
        size_px: Length of the longer side (px).
        supersample: Number of points per pixel along each axis; a pixel is the mean of its points.

    Returns:
        (H, W, 3) uint8 picture.
    """
    grid, scale = scene.grid, size_px * supersample / (max(scene.grid.rows, scene.grid.cols) * scene.grid.resolution_m)
    shape = [round(n * grid.resolution_m * scale) for n in (grid.cols, grid.rows)]
    image = Image.new("RGB", shape, "white")
    draw = ImageDraw.Draw(image, "RGBA")

    def pixels(point_m: Iterable[np.ndarray]) -> list[tuple[float, float]]:
        return [(scale * (grid.left_m - y), scale * (grid.front_m - x)) for x, y in point_m]

    outlines, center = compute_footprints_m(scene), scene.center_m[:, :2]
    ahead = np.stack([np.cos(scene.heading_rad), np.sin(scene.heading_rad)], axis=1) * scene.size_m[:, :1] / 2
    for k in (scene.center_m[:, 2] + scene.size_m[:, 2] / 2).argsort(kind="stable"):
        color = parse_rgb(COLOR_HEX[CATEGORIES[scene.category[k]]])
        path = pixels(outlines[k])
        draw.polygon(path, fill=(*color, 70))
        draw.line([*path, path[0]], fill=(*color, 255), width=round(0.5 * supersample + 1))
        if np.isfinite(scene.heading_rad[k]):
            draw.line(pixels([center[k], center[k] + ahead[k]]), fill=(*color, 255), width=round(0.5 * supersample + 1))
    return np.round(average_blocks(np.asarray(image), supersample)).astype(np.uint8)


class LayoutBox(NamedTuple):
    """Position of a picture on a plate (px)."""

    left: int
    top: int
    width: int
    height: int

    def of(self, plate: np.ndarray) -> np.ndarray:
        """Return the part of a plate inside the box."""
        return plate[self.top : self.top + self.height, self.left : self.left + self.width]


MARGIN, GAP, LARGE, WIDE, SMALL, SCALE = 56, 40, 720, 1060, 420, 64  # The 3D picture has WIDE x LARGE pixels.
PLATE_WIDTH = 2 * MARGIN + LARGE + GAP + WIDE
TOP_ROW = 190
BOTTOM_ROW = TOP_ROW + LARGE + 92
PLATE_HEIGHT = BOTTOM_ROW + SMALL + 56
GROUND_X = MARGIN
HEIGHTS_X = GROUND_X + SMALL + GAP
PRIMITIVES_X = HEIGHTS_X + SMALL + SCALE + GAP
LEGEND_X = PRIMITIVES_X + SMALL + GAP


def draw_scene_plate(scene: Scene) -> tuple[np.ndarray, dict[str, LayoutBox]]:
    """Draw one scene in all views, with its ids, labels and counts.

    The pictures are bev, 3d, ground, heights and primitives. The bev picture is the result of `render_bev`.

    Args:
        scene: Scene.

    Returns:
        (H, W, 3) uint8 plate, and the position of each picture on the plate.
    """
    bare = replace(scene, height_m=np.zeros_like(scene.height_m), occupied=np.zeros_like(scene.occupied))
    heights, span_m = draw_heights(scene, SMALL)
    extent = " x ".join(format_number(n * scene.grid.resolution_m) for n in (scene.grid.rows, scene.grid.cols))
    panels = {
        "bev": (
            render_bev(scene, LARGE, supersample=2),
            MARGIN,
            TOP_ROW,
            LARGE,
            f"View from above, {extent} m, forward at the top",
        ),
        "3d": (render_3d(scene, WIDE, LARGE), MARGIN + LARGE + GAP, TOP_ROW, LARGE, "Oblique view"),
        "ground": (
            render_bev(scene.select(np.zeros(0, int)), SMALL, supersample=2),
            GROUND_X,
            BOTTOM_ROW,
            SMALL,
            "Ground classes",
        ),
        "heights": (heights, HEIGHTS_X, BOTTOM_ROW, SMALL, "Ground height, m"),
        "primitives": (draw_footprints(bare, SMALL), PRIMITIVES_X, BOTTOM_ROW, SMALL, "Primitives, transparent"),
    }
    plate = Image.new("RGB", (PLATE_WIDTH, PLATE_HEIGHT), "white")
    draw = ImageDraw.Draw(plate)
    _draw_header(draw, scene)
    boxes = {}
    for name, (picture, left, top, size, title) in panels.items():
        rows, cols = picture.shape[:2]
        across = WIDE if name == "3d" else size
        box = LayoutBox(left + (across - cols) // 2, top + (size - rows) // 2, cols, rows)
        write_text(draw, left, top - 22, title, 20, INK)
        draw.rectangle((box.left - 1, box.top - 1, box.left + cols, box.top + rows), outline=LINE)
        plate.paste(Image.fromarray(picture), (box.left, box.top))
        boxes[name] = box
    _draw_ticks(draw, scene, boxes["bev"])
    if scene.occupied.any():
        _draw_scale(plate, draw, boxes["heights"], span_m)
    _draw_legend(draw, scene, LEGEND_X, BOTTOM_ROW)
    return np.asarray(plate), boxes


def _draw_header(draw: ImageDraw.ImageDraw, scene: Scene) -> None:
    x, y, z = scene.world_xyz_m
    write_text(draw, MARGIN, 54, fit_text(scene.scene_id, 40, PLATE_WIDTH - 2 * MARGIN), 40, INK)
    where = f"{scene.source}  ·  {scene.split}  ·  sequence {scene.sequence}  ·  frame {scene.frame}"
    pose = f"x {x:,.1f}, y {y:,.1f}, z {z:,.1f} m, yaw {np.degrees(scene.world_yaw_rad):.0f}°"
    write_text(draw, MARGIN, 98, f"{where}  ·  {pose}", 20)
    volume = {
        name: scene.volume_m3[
            np.isin(scene.category, [k for k, c in enumerate(CATEGORIES) if c.startswith(name)])
        ].sum()
        for name in ("vegetation", "vehicle")
    }
    parts = [
        f"{name} {getattr(scene, f'{name}_density') or 'without label'}, {format_number(float(round(volume[name])))} m³"
        for name in volume
    ]
    write_text(draw, MARGIN, 128, "  ·  ".join([*parts, f"{len(scene)} primitives"]), 20)


def _draw_ticks(draw: ImageDraw.ImageDraw, scene: Scene, box: LayoutBox) -> None:
    """Draw x ticks to the left of a view from above, and y ticks below the view."""
    grid = scene.grid
    for x in choose_ticks(grid.back_m, grid.front_m, 4):
        if grid.back_m <= x <= grid.front_m:
            at = box.top + (grid.front_m - x) / (grid.front_m - grid.back_m) * box.height
            draw.line((box.left - 6, at, box.left - 1, at), fill=SOFT)
            draw.text((box.left - 10, at), format_number(x), SOFT, load_font(14), anchor="rm")
    for y in choose_ticks(grid.right_m, grid.left_m, 4):
        if grid.right_m <= y <= grid.left_m:
            at = box.left + (grid.left_m - y) / (grid.left_m - grid.right_m) * box.width
            draw.line((at, box.top + box.height, at, box.top + box.height + 5), fill=SOFT)
            draw.text((at, box.top + box.height + 16), format_number(y), SOFT, load_font(14), anchor="mm")


def _draw_scale(plate: Image.Image, draw: ImageDraw.ImageDraw, box: LayoutBox, span_m: tuple[float, float]) -> None:
    """Draw the colour scale of heights in metres to the right of a picture."""
    low, high = span_m
    left = box.left + box.width + 14
    strip = make_color_ramp(np.linspace(1, 0, box.height))[:, None].repeat(16, axis=1)
    plate.paste(Image.fromarray(np.round(strip).astype(np.uint8)), (left, box.top))
    for value in choose_ticks(low, high):
        if low <= value <= high:
            at = box.top + (high - value) / (high - low) * (box.height - 1)
            draw.line((left + 16, at, left + 20, at), fill=SOFT)
            draw.text((left + 25, at), format_number(value), SOFT, load_font(14), anchor="lm")


def _draw_legend(draw: ImageDraw.ImageDraw, scene: Scene, left: int, top: int) -> None:
    """Draw the categories with their counts, and the ground classes with their shares of the grid."""
    size, step, right = 17, 25, PLATE_WIDTH - MARGIN
    share = scene.occupied.mean(axis=(1, 2))
    counts = [(name, format_number(int(n))) for name, n in zip(CATEGORIES, scene.counts(), strict=True)]
    areas = [(name, f"{100 * part:.1f} %") for name, part in zip(scene.ground_classes, share, strict=True)]
    write_text(draw, left, top - 22, "Primitives and ground", 20, INK)
    y = top + 9
    for rows in (counts, areas):
        for name, value in rows:
            draw_swatch(draw, left, y, name)
            write_text(draw, left + 26, y, spell_name(name), size, INK if value not in ("0", "0.0 %") else SOFT)
            draw.text((right, y), value, INK if value not in ("0", "0.0 %") else SOFT, load_font(size), anchor="rm")
            y += step
        y += 10


# ---------------------------------------------------------------------------------------------- sheets of scenes


def draw_scene_sheet(
    pictures: Sequence[np.ndarray], captions: Sequence[tuple[str, str]], title: str, columns: int | None = None
) -> np.ndarray:
    """Draw a sheet of pictures with a title above and the class colours below.

    Args:
        pictures: (H, W, 3) uint8 pictures.
        captions: Two lines of text per picture.
        title: Title.
        columns: Pictures per row. None: the number is chosen automatically.

    Returns:
        (H, W, 3) uint8 sheet.
    """
    height, width = (max(sizes) for sizes in zip(*(picture.shape[:2] for picture in pictures), strict=True))
    size, gap = max(11, round(width / 20)), max(12, width // 14)
    tiles = []
    for picture, (name, remark) in zip(pictures, captions, strict=True):
        tile = Image.new("RGB", (width, height + round(3 * size)), "white")
        tile.paste(Image.fromarray(picture))
        draw = ImageDraw.Draw(tile)
        draw.rectangle((0, 0, picture.shape[1] - 1, picture.shape[0] - 1), outline=LINE)
        write_text(draw, 0, height + size, fit_text(name, size, width), size, INK)
        write_text(draw, 0, height + 2.35 * size, remark, size)
        tiles.append(np.asarray(tile))
    body = arrange_contact_sheet(tiles, columns or choose_columns(len(tiles), width / height), gap_px=gap)
    return np.concatenate([_draw_title(title, body.shape[1], gap), body, _draw_colors(body.shape[1], gap)])


def choose_columns(count: int, aspect: float) -> int:
    """Choose the number of columns for an aspect ratio of about 5 : 4 and a last row with few empty places.

    Args:
        count: Number of pictures.
        aspect: Width / height of a picture.

    Returns:
        Number of columns.
    """
    middle = round(np.sqrt(count * 1.25 / aspect))
    near = range(max(1, round(0.75 * middle)), round(1.25 * middle) + 2)
    return min(near, key=lambda c: (-count % c, abs(c - middle)))


def _draw_title(text: str, width: int, margin: int) -> np.ndarray:
    size = min(36, max(18, width // 50))
    strip = Image.new("RGB", (width, round(2.2 * size)), "white")
    write_text(ImageDraw.Draw(strip), margin, 1.4 * size, fit_text(text, size, width - 2 * margin), size, INK)
    return np.asarray(strip)


def _draw_colors(width: int, margin: int) -> np.ndarray:
    """Draw a legend of the class colours, in one or more lines."""
    size = min(22, max(13, width // 90))
    places, x, line = [], margin, 0
    for name in COLOR_HEX:
        span = 1.5 * size + load_font(size).getlength(spell_name(name))
        if x > margin and x + span > width - margin:
            x, line = margin, line + 1
        places.append((x, line))
        x += span + 1.6 * size
    strip = Image.new("RGB", (width, round((line + 2) * 1.8 * size)), "white")
    draw = ImageDraw.Draw(strip)
    for name, (x, line) in zip(COLOR_HEX, places, strict=True):
        y = (line + 0.8) * 1.8 * size
        draw_swatch(draw, x, y, name, size)
        write_text(draw, x + 1.5 * size, y, spell_name(name), size)
    return np.asarray(strip)


def make_captions(catalogue: Catalogue, indices: np.ndarray, sort: str) -> list[tuple[str, str]]:
    """Make captions for scenes: scene id, number of primitives and value of the sort column."""
    names, totals = catalogue.column("scene_id"), catalogue.column("num_primitives")
    column = None if sort in ("drive", "random", "primitives", "num_primitives") else catalogue.sort_column(sort)
    values = None if column is None else catalogue.column(column)
    out = []
    for k in indices:
        remark = f"{totals[k]} primitives"
        if column is not None and values is not None:
            remark += f"  ·  {_format_quantity(column, float(values[k]))}"
        out.append((names[k], remark))
    return out


def _format_quantity(column: str, value: float) -> str:
    """Format a value with the name and unit of its column."""
    for ending, unit in (("_m3", " m³"), ("_m2", " m²"), ("_rad", " rad"), ("_m", " m")):
        if column.endswith(ending):
            name = column.removesuffix(ending).removesuffix("_volume").removesuffix("_area")
            digits = 0 if ending in ("_m2", "_m3") else 2
            return f"{spell_name(name)} {format_number(round(float(value), digits))}{unit}"
    return f"{spell_name(column.removeprefix('num_'))} {format_number(float(value))}"


def make_sheet_title(catalogue: Catalogue, count: int, sort: str, pick: str) -> str:
    """Describe a sheet in one line: sources, splits, number of scenes and order."""
    parts = (", ".join(sorted({getattr(shard, name) for shard in catalogue.shards})) for name in ("source", "split"))
    order = {"random": "at random", "drive": "along the drives"}.get(
        sort, f"by {spell_name(sort.removeprefix('num_'))}"
    )
    if sort != "random":
        order += {"uniform": "", "lowest": ", ascending", "highest": ", descending"}[pick]
    return "  ·  ".join([*parts, f"{format_number(count)} of {format_number(len(catalogue))} scenes", order])
