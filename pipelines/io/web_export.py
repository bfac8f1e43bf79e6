"""Convert a Scene to JSON for web/viewer.js: primitives, ground heights and an image of the ground."""

from __future__ import annotations

import base64
import io
from dataclasses import asdict

import numpy as np
from PIL import Image
from scipy import ndimage

from models.scene import CATEGORIES, ELLIPSOID, Scene
from pipelines.geometry.masks import find_nearest_true
from pipelines.schema.palette import CATEGORY_CLASS_ID, CLASS_COLORS, COLOR_HEX, EMPTY, list_ground_ids

NODES = 65  # Number of ground heights along the longer side. In a crop, the spacing is 1 m.


def export_web_scene(scene: Scene) -> dict:
    """Convert a scene to JSON for the viewer.

    Ground heights are rounded to centimetres and resampled to a coarser grid. All primitives are included.

    Args:
        scene: Scene.

    Returns:
        Dictionary with the keys scene_id, grid, ground and primitives.
    """
    return {
        "scene_id": scene.scene_id,
        "grid": asdict(scene.grid),
        "ground": _export_ground(scene),
        "primitives": [_export_primitive(scene, index) for index in range(len(scene))],
    }


def _export_ground(scene: Scene) -> dict:
    height_m, winner = scene.surface()
    filled_m = height_m if (winner < 0).all() else height_m[find_nearest_true(winner >= 0)]
    step = max(winner.shape) / (NODES - 1)
    rows, cols = (max(2, round(n / step) + 1) for n in winner.shape)
    at = [np.linspace(-0.5, n - 0.5, count) for n, count in zip(winner.shape, (rows, cols), strict=True)]
    nodes_m = ndimage.map_coordinates(filled_m, np.meshgrid(*at, indexing="ij"), order=1, mode="nearest")
    height_cm = np.round(100 * nodes_m).astype(int).ravel().tolist()
    return {"rows": rows, "cols": cols, "height_cm": height_cm, "picture": draw_ground(scene)}


def draw_ground(scene: Scene) -> str:
    """Draw the ground classes from above.

    Args:
        scene: Scene.

    Returns:
        PNG image as a data URI. Pixels without ground are transparent.
    """
    class_id = list_ground_ids(scene)[scene.surface()[1]]
    image = Image.fromarray(class_id, "P")
    image.putpalette(CLASS_COLORS.ravel().tolist())
    file = io.BytesIO()
    image.save(file, "PNG", optimize=True, transparency=EMPTY)
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"


def _export_primitive(scene: Scene, index: int) -> dict:
    category = CATEGORIES[scene.category[index]]
    heading = float(scene.heading_rad[index])
    return {
        "category": category,
        "class_id": CATEGORY_CLASS_ID[category],
        "color": COLOR_HEX[category],
        "ellipsoid": bool(scene.category[index] == ELLIPSOID),
        "center_m": _round_values(scene.center_m[index], 4),
        "size_m": _round_values(scene.size_m[index], 4),
        "rotation": _round_values(scene.rotation[index].ravel(), 6),
        "heading_rad": round(heading, 4) if np.isfinite(heading) else None,
        "label": str(scene.label[index]),
        "instance_id": int(scene.instance_id[index]),
        "existence": round(float(scene.existence[index]), 4),
    }


def _round_values(values: np.ndarray, digits: int) -> list[float]:
    return np.round(values.astype(float), digits).tolist()
