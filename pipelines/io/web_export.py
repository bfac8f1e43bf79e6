"""A Scene as what web/viewer.js shows: JSON of primitives, ground heights and a picture of the ground."""

from __future__ import annotations

import base64
import io
from dataclasses import asdict

import numpy as np
from PIL import Image
from scipy import ndimage

from models.scene import CATEGORIES, ELLIPSOID, Scene
from pipelines.schema.palette import CATEGORY_CLASS_ID, CLASS_COLORS, COLOR_HEX, EMPTY, ground_ids

NODES = 65  # of the ground's heights along the longer side, 1 m apart in a crop


def web_scene(scene: Scene) -> dict:
    """JSON for the viewer. Ground heights are rounded to centimetres and thinned; primitives are whole."""
    return {
        "scene_id": scene.scene_id,
        "grid": asdict(scene.grid),
        "ground": _ground(scene),
        "primitives": [_primitive(scene, index) for index in range(len(scene))],
    }


def _ground(scene: Scene) -> dict:
    height_m, winner = scene.surface()
    if (winner < 0).all():
        filled_m = height_m
    else:
        nearest = ndimage.distance_transform_edt(winner < 0, return_distances=False, return_indices=True)
        filled_m = height_m[tuple(nearest)]
    step = max(winner.shape) / (NODES - 1)
    rows, cols = (max(2, round(n / step) + 1) for n in winner.shape)
    at = [np.linspace(-0.5, n - 0.5, count) for n, count in zip(winner.shape, (rows, cols), strict=True)]
    nodes_m = ndimage.map_coordinates(filled_m, np.meshgrid(*at, indexing="ij"), order=1, mode="nearest")
    height_cm = np.round(100 * nodes_m).astype(int).ravel().tolist()
    return {"rows": rows, "cols": cols, "height_cm": height_cm, "picture": ground_picture(scene)}


def ground_picture(scene: Scene) -> str:
    """The ground's classes from above as a PNG data URI, transparent where nothing is known."""
    class_id = ground_ids(scene)[scene.surface()[1]]
    image = Image.fromarray(class_id, "P")
    image.putpalette(CLASS_COLORS.ravel().tolist())
    file = io.BytesIO()
    image.save(file, "PNG", optimize=True, transparency=EMPTY)
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"


def _primitive(scene: Scene, index: int) -> dict:
    category = CATEGORIES[scene.category[index]]
    heading = float(scene.heading_rad[index])
    return {
        "category": category,
        "class_id": CATEGORY_CLASS_ID[category],
        "color": COLOR_HEX[category],
        "ellipsoid": bool(scene.category[index] == ELLIPSOID),
        "center_m": _rounded(scene.center_m[index], 4),
        "size_m": _rounded(scene.size_m[index], 4),
        "rotation": _rounded(scene.rotation[index].ravel(), 6),
        "heading_rad": round(heading, 4) if np.isfinite(heading) else None,
        "label": str(scene.label[index]),
        "instance_id": int(scene.instance_id[index]),
        "existence": round(float(scene.existence[index]), 4),
    }


def _rounded(values: np.ndarray, digits: int) -> list[float]:
    return np.round(values.astype(float), digits).tolist()
