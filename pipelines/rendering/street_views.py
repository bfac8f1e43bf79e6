"""Render street views along the roads of scenes, with one Ray task per scene.

The output of a scene consists of images, cameras, a contact sheet and an animation.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from PIL import Image

from models.scene import Scene
from pipelines.geometry.centerlines import extract_road_network, plan_drive
from pipelines.rendering.pinhole import Lens, StreetCamera, StreetRenderer, StreetView, shade_view
from pipelines.rendering.render import arrange_contact_sheet, encode_png
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_tasks
from pipelines.schema.file_names import make_file_name
from pipelines.schema.palette import CLASS_ID
from pipelines.schema.run_guard import find_changed_option
from pipelines.schema.scene_subset import SceneSubset

# Units per metre in a 16-bit depth image, as in KITTI. The value 0 marks sky and depths greater than 255 m.
DEPTH_PER_M = 256
FRAMES_PER_SECOND = 10
ON_SHEET = 24
KINDS = ("semantic", "class_id", "instance", "depth", "shaded")  # Images of each frame.


@dataclass(frozen=True)
class StreetRequest:
    """Options of street views.

    The output directory is streets/<run>/<scene_id>/; `make_file_name` replaces unsafe letters of the id.

    Attributes:
        output: Output directory.
        run: Run name.
        spacing_m: Distance between cameras along the road (m).
        height_m: Height of a camera above the ground (m).
        pitch_deg: Upward angle of the view direction, in degrees.
        lens: Camera intrinsics.
        right: Offset to the right of the centreline, as a share of the road width.
        most: Maximum number of frames per scene; None: no limit.
    """

    output: str
    run: str
    spacing_m: float
    height_m: float
    pitch_deg: float
    lens: Lens
    right: float
    most: int | None

    def directory(self, scene_id: str) -> str:
        """Return the output directory of a scene.

        Args:
            scene_id: Id of the scene.

        Returns:
            Path or URI.
        """
        return storage.join_uri(self.output, "streets", self.run, make_file_name(scene_id))

    def list_files(self, scene_id: str, count: int) -> list[str]:
        """Return the files of a scene.

        Args:
            scene_id: Id of the scene.
            count: Number of frames.

        Returns:
            Paths or URIs of all files, of which cameras.json is written last.
        """
        names = [f"{kind}/{number:06d}.png" for kind in KINDS for number in range(count)]
        names += ["sheet.png", "drive.webp"] if count else []
        return [storage.join_uri(self.directory(scene_id), name) for name in (*names, "cameras.json")]


def place_cameras(way_m: np.ndarray, request: StreetRequest) -> list[StreetCamera]:
    """Place cameras along a path on the ground.

    Each camera looks along the path.

    Args:
        way_m: (k, 3) points of the path in the scene frame (m), k >= 2.
        request: Spacing, height, pitch and intrinsics of the cameras.

    Returns:
        Cameras at multiples of request.spacing_m along the path.
    """
    along_m = np.append(0, np.cumsum(np.linalg.norm(np.diff(way_m[:, :2], axis=0), axis=1)))
    count = int((along_m[-1] - 1e-6) // request.spacing_m) + 1
    at_m = np.arange(min(count, request.most or count)) * request.spacing_m
    position_m = np.stack([np.interp(at_m, along_m, way_m[:, axis]) for axis in range(3)], axis=1)
    ahead = np.gradient(way_m[:, :2], along_m, axis=0)
    ahead = np.stack([np.interp(at_m, along_m, ahead[:, axis]) for axis in (0, 1)], axis=1)
    yaw_rad, up_m = np.arctan2(ahead[:, 1], ahead[:, 0]), np.array([0, 0, request.height_m])
    pitch_rad = np.deg2rad(request.pitch_deg)
    return [
        StreetCamera.at(where + up_m, yaw, pitch_rad, request.lens)
        for where, yaw in zip(position_m, yaw_rad.tolist(), strict=True)
    ]


def serialize_camera(camera: StreetCamera) -> dict:
    """Return the pose and the intrinsics of a camera as JSON data.

    Args:
        camera: Camera in the scene.

    Returns:
        Dictionary with scene_from_camera, a 4 x 4 matrix (m), and the intrinsics (pixels).
    """
    scene_from_camera = np.eye(4)
    scene_from_camera[:3, :3], scene_from_camera[:3, 3] = camera.camera_from_scene.T, camera.position_m
    return {"scene_from_camera": scene_from_camera.tolist(), **asdict(camera.lens)}


def encode_depth(view: StreetView) -> np.ndarray:
    """Return the depth image of a street view.

    Args:
        view: Rendered images of one camera.

    Returns:
        (H, W) uint16 with DEPTH_PER_M units per metre; 0 for sky and for depths greater than 255 m.
    """
    depth = np.round(view.depth_m * DEPTH_PER_M)
    return np.where(depth < 2**16, depth, 0).astype(np.uint16)


def encode_animation(frames: list[np.ndarray], frames_per_second: float = FRAMES_PER_SECOND) -> bytes:
    """Encode frames as an animated WebP file, which web browsers display.

    Args:
        frames: Images (H, W, 3) uint8 of the same size.
        frames_per_second: Speed.

    Returns:
        Content of the file.
    """
    content, (first, *rest) = io.BytesIO(), [Image.fromarray(frame) for frame in frames]
    pause_ms = int(1000 / frames_per_second)
    first.save(content, "WEBP", save_all=True, append_images=rest, duration=pause_ms, loop=0, quality=80)
    return content.getvalue()


def write_street(scene: Scene, request: StreetRequest) -> int:
    """Render the street views of one scene.

    The function writes cameras.json last. A directory with this file is therefore complete.

    Args:
        scene: Scene.
        request: Cameras and output.

    Returns:
        Number of frames; 0 if the scene has no road.
    """
    directory, renderer = request.directory(scene.scene_id), StreetRenderer(scene)
    way_m = plan_drive(extract_road_network(scene), right=request.right)
    cameras = place_cameras(way_m, request) if len(way_m) > 1 else []
    frames = []
    for number, camera in enumerate(cameras):
        view = renderer.view(camera)
        frames.append(shade_view(view))
        images = (view.semantic, view.class_id, view.instance(), encode_depth(view), frames[-1])
        for kind, image in zip(KINDS, images, strict=True):
            path = storage.join_uri(directory, kind, f"{number:06d}.png")
            storage.write_whole(path, lambda stream, image=image: stream.write(encode_png(image)))
    if frames:
        every = frames[:: -(-len(frames) // ON_SHEET)]
        files = {
            "sheet.png": encode_png(arrange_contact_sheet(every, columns=3)),
            "drive.webp": encode_animation(frames),
        }
        for name, content in files.items():
            storage.write_whole(
                storage.join_uri(directory, name), lambda stream, content=content: stream.write(content)
            )
    about = {"scene_id": scene.scene_id, "source": scene.source, "depth_per_m": DEPTH_PER_M, "class_ids": CLASS_ID}
    about["frames"] = [serialize_camera(camera) for camera in cameras]
    storage.write_json(about, storage.join_uri(directory, "cameras.json"))
    return len(frames)


def render_streets(
    request: StreetRequest, selection: SceneSubset, on_scene: Callable[[], None] | None = None
) -> dict[str, int]:
    """Render street views of the selected scenes.

    A second call resumes an interrupted run.

    Args:
        request: Cameras and output.
        selection: Scenes.
        on_scene: Function that is called after each scene.

    Returns:
        Number of frames for each scene id; 0 for a scene without a road.

    Raises:
        ValueError: The output holds a run with the same name but other cameras, no scene has a road, or a file is
            missing at the end.
    """
    record = storage.join_uri(request.output, "streets", f"{request.run}.json")
    if said := find_changed_option(record, asdict(request)):
        raise ValueError(f"{request.output} holds a run {request.run!r} with {said}; choose another --run or --output")
    storage.write_json(asdict(request), record)
    chosen = [(shard, row) for shard, rows in selection.shards() for row in rows]

    def write_scene(number: int) -> dict:
        shard, position = chosen[number]
        (scene,) = shard.scenes([position])
        there = set(storage.list_files(directory := request.directory(scene.scene_id), ""))
        if (cameras := storage.join_uri(directory, "cameras.json")) in there:
            count = len(storage.read_json(cameras)["frames"])
            if there.issuperset(request.list_files(scene.scene_id, count)):
                return {"scene_id": scene.scene_id, "frames": count}
        return {"scene_id": scene.scene_id, "frames": write_street(scene, request)}

    frames = {}
    for row in map_tasks(write_scene, range(len(chosen))):
        frames[row["scene_id"]] = row["frames"]
        if on_scene:
            on_scene()
    if not any(frames.values()):
        raise ValueError(f"none of the {len(frames)} scenes has a road; street views need the ground class road")
    written = [path for scene_id, count in frames.items() for path in request.list_files(scene_id, count)]
    storage.require_files(written, storage.join_uri(request.output, "streets", request.run))
    return frames
