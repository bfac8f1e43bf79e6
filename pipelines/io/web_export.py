"""Convert a Scene to JSON for web/viewer.js: primitives, ground heights and an image of the ground."""

from __future__ import annotations

import base64
import io
import math
from dataclasses import asdict
from typing import Any

import numpy as np
import pyarrow as pa
from PIL import Image
from scipy import ndimage

from models.scene import CATEGORIES, ELLIPSOID, Scene
from pipelines.geometry.masks import find_nearest_true
from pipelines.schema.palette import CATEGORY_CLASS_ID, CLASS_COLORS, COLOR_HEX, EMPTY, list_ground_ids
from pipelines.schema.tracks import list_road_users

NODES = 65  # Number of ground heights along the longer side. In a crop, the spacing is 1 m.
OVERVIEW_NODES = 17


def export_web_scene(scene: Scene, ground: dict | None = None) -> dict:
    """Convert a scene to JSON for the viewer.

    Ground heights are rounded to centimetres and resampled to a coarser grid. All primitives are included.

    Args:
        scene: Scene.
        ground: Result of `export_ground` for this scene. None: it is computed.

    Returns:
        Dictionary with the keys scene_id, grid, ground and primitives.
    """
    return {
        "scene_id": scene.scene_id,
        "grid": asdict(scene.grid),
        "ground": ground or export_ground(scene),
        "primitives": _export_primitives(scene),
    }


def export_web_overview(scene: Scene, picture: np.ndarray) -> dict:
    """Convert a scene to JSON for views from afar: coarse ground, on which a picture shows the objects.

    Args:
        scene: Scene.
        picture: (h, w, 3) uint8 picture of the scene from above; ahead is up.

    Returns:
        Dictionary with the keys of `export_web_scene`; it has no primitives.
    """
    of_ground = _export_heights(scene, OVERVIEW_NODES) | {"picture": _encode_png(Image.fromarray(picture).quantize())}
    return {"scene_id": scene.scene_id, "grid": asdict(scene.grid), "ground": of_ground, "primitives": []}


def export_web_tracks(tracks: pa.Table) -> list[dict]:
    """Convert simulated traffic to JSON for the viewer.

    Args:
        tracks: Rows of the table tracks of one scene.

    Returns:
        One dictionary per road user, with the keys category, color, size_m, time_s (of each place) and places: x, y and
        z of the centre (m) and yaw (radians).
    """
    return [
        {
            "category": user.category,
            "color": COLOR_HEX[user.category],
            "size_m": np.round(user.size_m.astype(float), 3).tolist(),
            "time_s": user.time_s.astype(float).tolist(),
            "places": np.round(np.column_stack([user.center_m, user.yaw_rad]).astype(float), 3).tolist(),
        }
        for user in list_road_users(tracks)
    ]


def export_ground(scene: Scene) -> dict:
    """Convert the ground of a scene to JSON for the viewer.

    Args:
        scene: Scene.

    Returns:
        Dictionary with the keys rows, cols, height_cm and picture.
    """
    return _export_heights(scene, NODES) | {"picture": draw_ground(scene)}


def _export_heights(scene: Scene, nodes: int) -> dict:
    """Return rows, cols and height_cm of the ground, with a number of heights along the longer side."""
    height_m, winner = scene.surface()
    filled_m = height_m if (winner < 0).all() else height_m[find_nearest_true(winner >= 0)]
    step = max(winner.shape) / (nodes - 1)
    rows, cols = (max(2, round(n / step) + 1) for n in winner.shape)
    at = [np.linspace(-0.5, n - 0.5, count) for n, count in zip(winner.shape, (rows, cols), strict=True)]
    nodes_m = ndimage.map_coordinates(filled_m, np.meshgrid(*at, indexing="ij"), order=1, mode="nearest")
    height_cm = np.round(100 * nodes_m).astype(int).ravel().tolist()
    return {"rows": rows, "cols": cols, "height_cm": height_cm}


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
    return _encode_png(image, transparency=EMPTY)


def _encode_png(image: Image.Image, **options: Any) -> str:
    """Return a PNG image as a data URI."""
    file = io.BytesIO()
    image.save(file, "PNG", optimize=True, **options)
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"


def _export_primitives(scene: Scene) -> list[dict]:
    center_m, size_m = (np.round(values.astype(float), 4).tolist() for values in (scene.center_m, scene.size_m))
    rotation = np.round(scene.rotation.reshape(-1, 9).astype(float), 6).tolist()
    heading, existence = (np.round(values.astype(float), 4).tolist() for values in (scene.heading_rad, scene.existence))
    names = [CATEGORIES[index] for index in scene.category]
    return [
        {
            "category": name,
            "class_id": CATEGORY_CLASS_ID[name],
            "color": COLOR_HEX[name],
            "ellipsoid": bool(scene.category[index] == ELLIPSOID),
            "center_m": center_m[index],
            "size_m": size_m[index],
            "rotation": rotation[index],
            "heading_rad": heading[index] if math.isfinite(heading[index]) else None,
            "label": str(scene.label[index]),
            "instance_id": int(scene.instance_id[index]),
            "existence": existence[index],
        }
        for index, name in enumerate(names)
    ]
