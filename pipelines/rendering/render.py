"""Render pictures of a Scene, from above in flat class colours or oblique in soft light, and sheets of pictures."""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import cache

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from models.scene import ELLIPSOID, Grid, Scene
from pipelines.geometry.orthographic import (
    find_ellipsoids_over,
    find_facing_sides,
    make_oblique_camera,
    make_top_camera,
)
from pipelines.geometry.rasterize import fill_triangles, find_hits
from pipelines.io.mesh_export import triangulate_cuboids
from pipelines.rendering.shading import render_lit
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS, EMPTY, list_ground_ids

MARK_COLOR = (230, 0, 0)  # sRGB, of lines drawn over a picture


def render_bev(scene: Scene, size_px: int = 256, supersample: int = 1) -> np.ndarray:
    """Render the scene from above in class colours, white where it is empty.

    Orthographic, up = +x (forward), left = +y; the grid fills the picture. Metrics use this picture; it is
    bit-identical on every call.

    Args:
        scene: Scene.
        size_px: Pixels of the longer side.
        supersample: Each pixel is the mean of supersample^2 points.

    Returns:
        (H, W, 3) uint8 sRGB.
    """
    view = _make_oblique_view(scene.grid, size_px * supersample)
    ground_m, ground = scene.surface()
    if view != scene.grid:
        row, col = scene.grid.pixel(view.x_m(), view.y_m())
        ground_m, ground = (raster.take(row, axis=0).take(col, axis=1) for raster in (ground_m, ground))
    top, class_id = np.full(ground_m.shape, -np.inf), np.full(ground_m.shape, EMPTY, np.uint8)
    boxes = triangulate_cuboids(scene)
    seen = find_facing_sides(boxes.corners_m)
    box_hits = find_hits(boxes.corners_m.take(seen, axis=0), view, boxes.class_id.take(seen))
    fill_triangles(*box_hits, top.reshape(-1), class_id.reshape(-1))
    bare = (ground >= 0) & (top <= ground_m)
    np.copyto(top, ground_m, where=bare)
    np.copyto(class_id, list_ground_ids(scene).take(ground), where=bare)
    class_id.reshape(-1)[find_ellipsoids_over(scene, make_top_camera(view), top)] = CATEGORY_IDS[ELLIPSOID]
    picture = _paint_pixels(class_id)
    return picture if supersample == 1 else np.round(average_blocks(picture, supersample)).astype(np.uint8)


def render_outlined_bev(scene: Scene, region: np.ndarray, size_px: int = 512) -> np.ndarray:
    """Render the scene from above with the border of a region (rows, cols), True inside: (H, W, 3) uint8."""
    picture = render_bev(scene, size_px, supersample=2).copy()
    view = _make_oblique_view(scene.grid, size_px)
    origin = np.zeros(1)
    inside = region[scene.grid.pixel(view.x_m(), origin)[0]][:, scene.grid.pixel(origin, view.y_m())[1]]
    border = np.zeros_like(inside)
    border[1:] |= inside[1:] != inside[:-1]
    border[:, 1:] |= inside[:, 1:] != inside[:, :-1]
    picture[border] = MARK_COLOR
    return picture


@cache
def _list_color_pairs() -> np.ndarray:
    """(18 x 256, 6) colours of two neighbouring pixels, by the first's class id plus 256 times the second's."""
    first, second = np.zeros((2, len(CLASS_COLORS), 256, 3), np.uint8)
    first[:, : len(CLASS_COLORS)], second[:] = CLASS_COLORS, CLASS_COLORS[:, None]
    return np.concatenate([first, second], axis=2).reshape(-1, 6)


def _paint_pixels(class_id: np.ndarray) -> np.ndarray:
    """(H, W, 3) CLASS_COLORS[class_id (H, W) uint8], two pixels at a time: copying six bytes is as fast as three."""
    pair = np.resize(class_id, class_id.size + class_id.size % 2).view("<u2")
    return _list_color_pairs().take(pair, axis=0).reshape(-1, 3)[: class_id.size].reshape(*class_id.shape, 3)


def _make_oblique_view(grid: Grid, size_px: int) -> Grid:
    """Return a grid of the same rectangle with size_px pixels along its longer side."""
    resolution_m = max(grid.rows, grid.cols) * grid.resolution_m / size_px
    rows, cols = (max(1, round(n * grid.resolution_m / resolution_m)) for n in (grid.rows, grid.cols))
    return Grid(grid.front_m, grid.left_m, resolution_m, rows, cols)


def render_3d(
    scene: Scene,
    width: int = 800,
    height: int = 600,
    azimuth_deg: float = 30.0,
    elevation_deg: float = 38.0,
    supersample: int = 2,
) -> np.ndarray:
    """Render the scene as a model on a table, in soft light, orthographic: (height, width, 3) uint8 sRGB.

    The camera looks along +x (forward) turned left by azimuth_deg, and down by elevation_deg. It depends on the
    scene's grid only, so pictures of scenes of one size are comparable. The light plate under the scene is visible
    where the ground is unknown.
    """
    camera = make_oblique_camera(scene.grid, width * supersample, height * supersample, azimuth_deg, elevation_deg)
    linear = average_blocks(render_lit(scene, camera), supersample)
    return np.round(255 * linear.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)


def encode_png(image: np.ndarray) -> bytes:
    """Encode (H, W) uint8 or uint16, or (H, W, 3) uint8, as a PNG file."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG")  # `optimize` makes it a tenth smaller in five times the time
    return file.getvalue()


def average_blocks(picture: np.ndarray, factor: int) -> np.ndarray:
    """Replace each factor x factor block of (H, W, C) by its mean, float32."""
    rows, cols = picture.shape[0] // factor, picture.shape[1] // factor
    total = np.zeros((rows, cols, picture.shape[2]), np.float32)
    for i in range(factor):
        for j in range(factor):
            total += picture[i : rows * factor : factor, j : cols * factor : factor]
    return total / factor**2


def arrange_contact_sheet(
    pictures: Sequence[np.ndarray], columns: int, captions: Sequence[str] | None = None, gap_px: int = 12
) -> np.ndarray:
    """Arrange pictures (h, w, 3) uint8 in rows of `columns` on white, each over its caption: (H, W, 3) uint8.

    Cells have the size of the largest picture. Raises ValueError if there is no picture or a caption is missing.
    """
    captions = [""] * len(pictures) if captions is None else captions
    if len(pictures) == 0 or len(captions) != len(pictures):
        raise ValueError(f"{len(pictures)} pictures and {len(captions)} captions: need one or more, one each")
    cell_h, cell_w = max(p.shape[0] for p in pictures), max(p.shape[1] for p in pictures)
    text_size = max(11, cell_w // 26)
    font = ImageFont.load_default(size=text_size)
    text_h = int(1.6 * text_size) if any(captions) else 0
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    step_x, step_y = cell_w + gap_px, cell_h + text_h + gap_px
    sheet = Image.new("RGB", (columns * step_x + gap_px, rows * step_y + gap_px), "white")
    draw = ImageDraw.Draw(sheet)
    for index, (picture, caption) in enumerate(zip(pictures, captions, strict=True)):
        left, top = gap_px + index % columns * step_x, gap_px + index // columns * step_y
        inset = (cell_w - picture.shape[1]) // 2, (cell_h - picture.shape[0]) // 2
        sheet.paste(Image.fromarray(picture), (left + inset[0], top + inset[1]))
        draw.text((left + cell_w / 2, top + cell_h + 0.7 * text_h), caption, "#333333", font, anchor="mm")
    return np.asarray(sheet)
