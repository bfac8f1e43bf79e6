"""Render a Scene from above in flat class colours, or obliquely in soft light. Arrange images on a sheet."""

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

MARK_COLOR = (230, 0, 0)  # sRGB colour of lines over an image.


def render_bev(scene: Scene, size_px: int = 256, supersample: int = 1) -> np.ndarray:
    """Render a scene from above in class colours.

    Empty areas are white. The projection is orthographic with +x (forward) up and +y left. The grid fills the image.
    The image is bit-identical on every call, because metrics use it.

    Args:
        scene: Scene.
        size_px: Number of pixels along the longer side.
        supersample: Number of samples per pixel along each axis; a pixel is the mean of its samples.

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
    """Render a scene from above, and draw the border of a region as a line.

    Args:
        scene: Scene.
        region: (rows, cols) mask in the raster grid of the scene; True inside the region.
        size_px: Number of pixels along the longer side.

    Returns:
        (H, W, 3) uint8 sRGB.
    """
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
    """Return the colours (18 x 256, 6) of two neighbouring pixels.

    The row index is the class id of the first pixel plus 256 times that of the second.
    """
    first, second = np.zeros((2, len(CLASS_COLORS), 256, 3), np.uint8)
    first[:, : len(CLASS_COLORS)], second[:] = CLASS_COLORS, CLASS_COLORS[:, None]
    return np.concatenate([first, second], axis=2).reshape(-1, 6)


def _paint_pixels(class_id: np.ndarray) -> np.ndarray:
    """Return CLASS_COLORS[class_id] (H, W, 3) for class_id (H, W) uint8.

    The function processes two pixels at a time, because copying six bytes takes the same time as copying three bytes.
    """
    pair = np.resize(class_id, class_id.size + class_id.size % 2).view("<u2")
    return _list_color_pairs().take(pair, axis=0).reshape(-1, 3)[: class_id.size].reshape(*class_id.shape, 3)


def _make_oblique_view(grid: Grid, size_px: int) -> Grid:
    """Return a grid that covers the same rectangle with size_px pixels along the longer side."""
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
    """Render a scene obliquely with an orthographic camera, like a model on a table in soft light.

    The camera depends only on the scene's grid. Images of two scenes with the same grid are therefore comparable. A
    light-coloured plate under the scene is visible where the scene has no ground.

    Args:
        scene: Scene.
        width: Image width in pixels.
        height: Image height in pixels.
        azimuth_deg: Angle of the view direction to the left of +x (forward), in degrees.
        elevation_deg: Downward angle of the view direction, in degrees, in (0, 90].
        supersample: Number of samples per pixel along each axis; a pixel is the mean of its samples.

    Returns:
        (height, width, 3) uint8 sRGB.
    """
    camera = make_oblique_camera(scene.grid, width * supersample, height * supersample, azimuth_deg, elevation_deg)
    linear = average_blocks(render_lit(scene, camera), supersample)
    return np.round(255 * linear.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)


def encode_png(image: np.ndarray) -> bytes:
    """Encode an image as a PNG file.

    Args:
        image: (H, W) uint8 or uint16, or (H, W, 3) uint8.

    Returns:
        Content of the file.
    """
    file = io.BytesIO()
    # The option `optimize` reduces the size by 10 % but takes five times as long.
    Image.fromarray(image).save(file, "PNG")
    return file.getvalue()


def average_blocks(picture: np.ndarray, factor: int) -> np.ndarray:
    """Reduce an image: replace each block of factor x factor pixels by its mean.

    Args:
        picture: (H, W, C) image.
        factor: Block size in pixels.

    Returns:
        (H // factor, W // factor, C) float32.
    """
    rows, cols = picture.shape[0] // factor, picture.shape[1] // factor
    total = np.zeros((rows, cols, picture.shape[2]), np.float32)
    for i in range(factor):
        for j in range(factor):
            total += picture[i : rows * factor : factor, j : cols * factor : factor]
    return total / factor**2


def arrange_contact_sheet(
    pictures: Sequence[np.ndarray], columns: int, captions: Sequence[str] | None = None, gap_px: int = 12
) -> np.ndarray:
    """Arrange images on a white sheet.

    The caption is below each image. Each image gets a cell with the size of the largest image.

    Args:
        pictures: Images (h, w, 3) uint8.
        columns: Number of images per row.
        captions: One caption per image (default: none).
        gap_px: Distance between images in pixels.

    Returns:
        (H, W, 3) uint8 sheet.

    Raises:
        ValueError: There is no image, or the number of captions differs from the number of images.
    """
    captions = [""] * len(pictures) if captions is None else captions
    if len(pictures) == 0 or len(captions) != len(pictures):
        raise ValueError(
            f"got {len(pictures)} pictures and {len(captions)} captions; expected at least one picture and one caption"
            " per picture"
        )
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
