"""Draw the picture of README from the released weights: scenes by label, one of them outpainted, and street views.

python docs/hero.py            writes docs/pictures/hero.png in two minutes on two cores
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from models import PrITTIPipeline
from models.scene import Scene
from pipelines.geometry.centerlines import extract_road_network, plan_drive
from pipelines.rendering.pinhole import Lens, StreetRenderer, shade_view
from pipelines.rendering.render import encode_png, render_3d
from pipelines.rendering.street_views import StreetRequest, place_cameras

GAP, WIDTH, HEIGHT, FRAME = 12, 480, 360, 154  # Gap between pictures, size of a scene, height of a street view (px).
SEED = 0
FRAMES = 3


def draw_street_views(scene: Scene) -> list[np.ndarray]:
    """Draw street views at equal distances along the road of a scene."""
    lens = Lens().resize(WIDTH, FRAME)
    request = StreetRequest("", "", 1.0, 1.55, 0.0, lens, 0.25, None)
    cameras = place_cameras(plan_drive(extract_road_network(scene)), request)
    renderer = StreetRenderer(scene)
    return [shade_view(renderer.view(cameras[k])) for k in np.linspace(0, 0.6 * len(cameras), FRAMES).astype(int)]


def stack_pictures(pictures: list[np.ndarray], axis: int) -> np.ndarray:
    """Stack pictures from left to right (axis 1) or from top to bottom (axis 0), with white between them."""
    shape = list(pictures[0].shape)
    shape[axis] = GAP
    white = np.full(shape, 255, np.uint8)
    return np.concatenate([part for picture in pictures for part in (picture, white)][:-1], axis)


def main() -> None:
    pipeline = PrITTIPipeline.from_pretrained("town")
    pipeline.set_progress_bar_config(desc="outpaint")
    made = {}
    for label in ("low-high", "medium-medium", "high-low"):
        made[label] = pipeline.generate([label], seed=SEED)[0]
    larger = pipeline.outpaint(made["medium-medium"], "medium-medium", seed=SEED, free_blocks="all", plan_streets=True)
    above = stack_pictures([render_3d(scene, WIDTH, HEIGHT) for scene in made.values()], 1)
    views = stack_pictures(draw_street_views(larger), 0)
    below = stack_pictures([render_3d(larger, 2 * WIDTH + GAP, len(views)), views], 1)
    (Path(__file__).parent / "pictures/hero.png").write_bytes(encode_png(stack_pictures([above, below], 0)))


if __name__ == "__main__":
    main()
