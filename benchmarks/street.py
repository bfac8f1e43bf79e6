"""Compare the times of this project's renderer and of embree for street views of 704 x 188 pixels.

    python benchmarks/street.py

The scenes are dense towns of about 250 primitives, with cameras along their roads. Embree casts one ray per pixel at a
mesh of the whole scene. In this mesh, ellipsoids consist of facets. The search tree of embree is built once per scene,
like the triangles of this project's renderer. This project's renderer also returns normals and intersects ellipsoids
exactly. Times are CPU seconds of one thread; the target is 250 ms per frame.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import trimesh
import tyro
from common import DENSE_SEEDS, describe_machine, format_ratios, spread, time_interleaved

from models.scene import Scene
from pipelines.geometry.centerlines import extract_road_network, plan_drive
from pipelines.io.mesh_export import triangulate_scene
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.rendering.pinhole import Lens, StreetCamera, StreetRenderer, shade_view
from pipelines.rendering.render import encode_png
from pipelines.rendering.street_views import StreetRequest, encode_depth, place_cameras
from pipelines.schema.palette import EMPTY

ROUNDS = 5
FRAMES = 8  # of a scene


def cast(scene: Scene, cameras: list[StreetCamera]) -> list[np.ndarray]:
    """Cast rays with embree and return class ids (h, w)."""
    soup = triangulate_scene(scene)
    mesh = trimesh.Trimesh(
        soup.corners_m.reshape(-1, 3), np.arange(3 * len(soup.corners_m)).reshape(-1, 3), process=False
    )
    pictures = []
    for camera in cameras:
        lens = camera.lens
        u, v = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
        local = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(u.shape)], axis=-1)
        rays = (local @ camera.camera_from_scene).reshape(-1, 3)
        triangle = mesh.ray.intersects_first(np.broadcast_to(camera.position_m, rays.shape), rays)
        pictures.append(np.where(triangle >= 0, soup.class_id[triangle], EMPTY).reshape(u.shape))
    return pictures


def render_class_ids(scene: Scene, cameras: list[StreetCamera]) -> list[np.ndarray]:
    renderer = StreetRenderer(scene)
    return [renderer.view(camera).class_id for camera in cameras]


def write(scene: Scene, cameras: list[StreetCamera]) -> None:
    """Write all images that jobs/render_streets.py writes, as PNG files in memory."""
    renderer = StreetRenderer(scene)
    for camera in cameras:
        view = renderer.view(camera)
        for image in (view.semantic, view.class_id, view.instance(), encode_depth(view), shade_view(view)):
            encode_png(image)


def main() -> None:
    print(describe_machine())
    request, chosen = StreetRequest("", "", 1.0, 1.55, 0.0, Lens().resize(704, 188), 0.25, FRAMES), []
    for seed in DENSE_SEEDS:
        scene = generate_town(seed).scene(20)
        cameras = place_cameras(plan_drive(extract_road_network(scene)), request)
        chosen += [(scene, cameras)] if cameras else []
    frames = sum(len(cameras) for _, cameras in chosen)
    print(
        f"{len(chosen)} scenes of {np.mean([len(scene) for scene, _ in chosen]):.0f} primitives, "
        f"{frames} frames of {request.lens.width} x {request.lens.height}"
    )
    same = [
        a == b
        for scene, cameras in chosen
        for a, b in zip(cast(scene, cameras), render_class_ids(scene, cameras), strict=True)
    ]
    ways = {"embree": cast, "ours": render_class_ids, "ours, shaded and written": write}
    seconds = time_interleaved(
        {name: lambda _, way=way: [way(*one) for one in chosen] for name, way in ways.items()}, ROUNDS
    )
    for name, values in seconds.items():
        print(f"{name}: {spread([1e3 * value / frames for value in values], 1, 0)} ms per frame")
    print(
        f"embree / ours: {format_ratios(seconds['embree'], seconds['ours'])}; "
        f"{100 * np.mean(same):.2f} % of pixels of one class (facets differ from ellipsoids at their rims)"
    )


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
