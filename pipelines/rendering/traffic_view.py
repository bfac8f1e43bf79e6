"""Draw simulated traffic from above as an animation."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from PIL import Image, ImageDraw

from models.scene import CATEGORY_INDEX, Scene
from pipelines.geometry.parked_vehicles import find_driving_vehicles
from pipelines.rendering.render import render_bev
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS
from pipelines.traffic.obstacles import make_footprints

SUPERSAMPLE = 2
MOVING = (255, 220, 60)  # Colour of moving vehicles.


def render_traffic(scene: Scene, tracks: pa.Table, size_px: int = 512, duration_s: float = 60.0) -> list[np.ndarray]:
    """Draw a scene with its simulated traffic.

    Vehicles of the scene that are in traffic are left out, because they are part of the simulation.

    Args:
        scene: Scene.
        tracks: Rows of the table tracks of this scene.
        size_px: Number of pixels of the longer side.
        duration_s: Time that is shown, from the first road user (s).

    Returns:
        One image (H, W, 3) uint8 per time.
    """
    ground = Image.fromarray(render_bev(scene.select(~find_driving_vehicles(scene)), SUPERSAMPLE * size_px))
    scale = max(ground.size) / (max(scene.grid.rows, scene.grid.cols) * scene.grid.resolution_m)
    table = {name: tracks[name].to_numpy() for name in ("time_s", "x_m", "y_m", "yaw_rad", "length_m", "width_m")}
    categories = np.array(tracks["category"].to_pylist())
    frames = []
    times_s = np.unique(table["time_s"])
    for time_s in times_s[times_s <= times_s[:1] + duration_s]:
        now = table["time_s"] == time_s
        xy_m = np.stack([table["x_m"][now], table["y_m"][now]], axis=1)
        size_m = np.stack([table["length_m"][now], table["width_m"][now]], axis=1).clip(0.8)
        shapes = make_footprints(xy_m, table["yaw_rad"][now], size_m)
        frame = ground.copy()
        pen = ImageDraw.Draw(frame)
        for shape, category in zip(shapes, categories[now], strict=True):
            x_m, y_m = np.array(shape.exterior.coords).T
            corners = np.stack([(scene.grid.left_m - y_m) * scale, (scene.grid.front_m - x_m) * scale], axis=1)
            color = (
                MOVING
                if category != "human"
                else tuple(int(v) for v in CLASS_COLORS[CATEGORY_IDS[CATEGORY_INDEX[category]]])
            )
            pen.polygon([(float(u), float(v)) for u, v in corners], fill=color, outline=(30, 30, 30))
        frames.append(np.asarray(frame.resize((ground.width // SUPERSAMPLE, ground.height // SUPERSAMPLE))))
    return frames
