"""Helpers for several test modules: scenes, a tiny pipeline, processes and an HTML parser."""

import os
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import torch

from models.dit import DiT
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.pipeline import PrITTIPipeline
from models.presets import LVAE_PRESETS
from models.sampling.repaint import RePaintConfig
from models.scene import (
    CATEGORIES,
    CATEGORY_INDEX,
    KITTI_GROUND_CLASSES,
    PER_PRIMITIVE,
    UNSET,
    Grid,
    Scene,
    canonicalize_boxes,
    make_yaw_rotation,
)
from models.street_planner import StreetPlanner
from pipelines.schema.palette import CLASS_ID, EMPTY
from pipelines.traffic.tracks import Tracks

ROOT = Path(__file__).parents[1]  # folder of the repository
LATENT_SHAPE = (4, 8, 8)
VOID = {"meta", "img", "line", "polyline", "rect", "circle"}  # elements without a closing tag
QUICK = RePaintConfig(num_inference_steps=6, jump_length=2, resamplings=2)
SHARD_SIZES = (5, 3, 7, 4, 6)
TOWN_SLOTS = {"vegetation_cuboid": 90, "vehicle_small": 12}  # slots in the fixture town_dataset
REJECT_REASON = "heights <beyond> 327 m"


def random_rotations(rng: np.random.Generator, n: int, tilt_rad: float = np.pi) -> np.ndarray:
    """Return n random rotations (n, 3, 3) with any yaw and with a pitch of at most tilt_rad."""
    yaw, pitch = rng.uniform(-np.pi, np.pi, n), rng.uniform(-tilt_rad, tilt_rad, n)
    cos, sin, zero, one = np.cos(pitch), np.sin(pitch), np.zeros(n), np.ones(n)
    tilt = np.stack([np.stack(r, -1) for r in ([cos, zero, sin], [zero, one, zero], [-sin, zero, cos])], -2)
    return make_yaw_rotation(yaw) @ tilt


def random_scene(seed: int = 0, n: int = 40, grid: Grid | None = None, tilt_rad: float = 0.2, **fields) -> Scene:
    """Return a scene with n primitives of random categories, in which ground fills half planes."""
    rng = np.random.default_rng(seed)
    grid = grid or Grid()
    size = rng.uniform(0.3, 5.0, (n, 3))
    rotation, size = canonicalize_boxes(random_rotations(rng, n, tilt_rad), size)
    classes = KITTI_GROUND_CLASSES
    angle, offset = rng.uniform(-np.pi, np.pi, (2, len(classes), 1, 1)) * [[[[1]]], [[[5]]]]
    occupied = np.cos(angle) * (grid.x_m()[:, None] - 32) + np.sin(angle) * grid.y_m() > offset  # half planes
    slope = 0.01 * grid.x_m()[:, None] - 0.02 * grid.y_m()[None, :]
    height = np.where(occupied, slope[None] - 0.6 + 0.1 * np.arange(len(classes))[:, None, None], 0)
    defaults = {
        "scene_id": f"test-{seed:04d}",
        "source": "town",
        "sequence": "00000",
        "frame": seed,
        "split": "train",
        "category": rng.integers(0, len(CATEGORIES), n).astype(np.int8),
        "center_m": rng.uniform([0, -32, -2], [64, 32, 6], (n, 3)).astype(np.float32),
        "rotation": rotation.astype(np.float32),
        "size_m": size.astype(np.float32),
        "ground_classes": classes,
        "height_m": height.astype(np.float32),
        "occupied": occupied,
        "grid": grid,
    }
    return Scene(**(defaults | fields))


def small_spec(pixels: int = 32, slots: int = 6) -> LayoutSpec:
    return LayoutSpec(slots=(slots,) * len(CATEGORIES)).with_resolution(pixels)


def tiny_pipeline(spec: LayoutSpec) -> PrITTIPipeline:
    """Return a pipeline with random weights: an LVAE of the smoke preset and a DiT of one block."""
    torch.manual_seed(0)
    lvae = LayoutVAE(layout=spec.to_dict(), **LVAE_PRESETS["smoke"].architecture())
    channels, size, _ = lvae.latent_shape
    dit = DiT(channels=channels, size=size, width=32, depth=1, heads=2, layout=spec.to_dict())
    for parameter in dit.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    made = PrITTIPipeline(lvae, dit)
    made.set_progress_bar_config(disable=True)
    return made


def tiny_planner(size: int = 32) -> StreetPlanner:
    """Return a street planner with random weights, for windows of 4 m per pixel."""
    torch.manual_seed(0)
    made = StreetPlanner(size=size, block_px=4, widths=(32,), shift=(-5.0, -4.0), scale=(4.0, 4.0))
    return made.eval().requires_grad_(False)


def fit_here(run, num_workers: int, output: str, min_workers: int | None) -> str:
    """Train in this process instead of with Ray Train (`jobs.support.trainer.fit`)."""
    from jobs.support.trainer import convert_to_tensors, tag_weights
    from pipelines.training.data_loader import iterate_batches

    trainer = run.build(torch.device("cpu"), lambda model: model)
    for batch in iterate_batches(run.stream, run.reader, 0, run.settings.steps):
        trainer.step(convert_to_tensors(batch), range(run.stream.batch_size))
    model = trainer.ema_model()
    tag_weights(run.tracker, model, trainer.steps_done)
    model.save_pretrained(output)
    run.tracker.finish("FINISHED")
    return output


def scenes_equal(a, b) -> bool:
    """Return True if two scenes are equal in all fields that decoders predict."""
    names = ("category", "center_m", "size_m", "rotation", "height_m", "occupied")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def example_scene(n: int = 60, grid: Grid | None = None, seed: int = 0) -> Scene:
    """Return a road with sidewalks on rolling terrain, with n tilted primitives of all categories."""
    rng = np.random.default_rng(seed)
    grid = grid or Grid()
    x, y = np.meshgrid(grid.x_m(), grid.y_m(), indexing="ij")
    height = np.stack([0.5 * np.sin(x / 17) + 0.2 * np.cos(y / 11) + 0.05 * k for k in range(5)]).astype(np.float32)
    road, bay = np.abs(y) < 3.5, (y > 5) & (y < 10) & (x % 20 < 8)
    beside, far = (np.abs(y) >= 3.5) & (np.abs(y) < 6), (np.abs(y) > 6) & (x % 30 < 18)
    occupied = np.stack([road, beside, bay, far, (y < -20) & (x < 20)])
    category = (np.arange(n) % len(CATEGORIES)).astype(np.int8)
    size = rng.uniform(0.5, 6, (n, 3))
    low, high = [grid.back_m, grid.right_m, 0], [grid.front_m, grid.left_m, 3]
    tilt = rng.uniform(-0.1, 0.1, n)
    roll = np.stack([[1 + 0 * tilt, 0 * tilt, 0 * tilt], [0 * tilt, np.cos(tilt), -np.sin(tilt)],
                     [0 * tilt, np.sin(tilt), np.cos(tilt)]]).transpose(2, 0, 1)  # fmt: skip
    rotation, size = canonicalize_boxes(make_yaw_rotation(rng.uniform(-np.pi, np.pi, n)) @ roll, size)
    return Scene(
        scene_id="town-1-0000000007",
        source="town",
        sequence="1",
        frame=7,
        split="test",
        category=category,
        center_m=rng.uniform(low, high, (n, 3)).astype(np.float32),
        rotation=rotation.astype(np.float32),
        size_m=size.astype(np.float32),
        ground_classes=KITTI_GROUND_CLASSES,
        height_m=np.where(occupied, height, 0).astype(np.float32),
        occupied=occupied,
        grid=grid,
        instance_id=np.arange(n) + 1000,
    )


def empty_scene() -> Scene:
    """Return a scene without primitives and without ground."""
    scene = example_scene(0)
    return Scene(
        scene_id="town-1-0000000008",
        source="town",
        sequence="1",
        frame=8,
        split="test",
        category=scene.category,
        center_m=scene.center_m,
        rotation=scene.rotation,
        size_m=scene.size_m,
        ground_classes=scene.ground_classes,
        height_m=np.zeros_like(scene.height_m),
        occupied=np.zeros_like(scene.occupied),
    )


def run_command(*words: str, **environment: str) -> subprocess.CompletedProcess:
    """Run a Python script from the root of the repository with additional environment variables."""
    return subprocess.run(
        [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, env=os.environ | environment, timeout=120
    )


def kill_ray_workers(title: str) -> list[int]:
    """Kill all Ray workers of this process whose title contains `title` and return their process ids."""
    import psutil  # Ray bundles this module; import ray first

    killed = []
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error, IndexError):
            if title in process.cmdline()[0]:
                process.kill()
                killed.append(process.pid)
    return killed


class Page(HTMLParser):
    """A parsed HTML page with its elements and text.

    Raises AssertionError if an element is not closed in order.
    """

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open, self.elements, self.text = [], [], ""
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.text += data

    def all(self, tag):
        return [attrs for name, attrs in self.elements if name == tag]


def assert_same_primitives(got: Scene, want: Scene, but: tuple[str, ...] = ()) -> None:
    """Assert that all fields of the primitives are equal; ignore the fields in `but`."""
    for name in set(PER_PRIMITIVE) - set(but):
        assert np.array_equal(getattr(got, name), getattr(want, name), equal_nan=name == "heading_rad"), name


class SvgPage(Page):
    """A page with titles in its SVG shapes. Only the elements `meta` and `img` have no closing tag."""

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self.open.append(tag)


def street_class_ids(rows: int = 44, cols: int = 60) -> np.ndarray:
    """Return class ids of a picture (rows, cols) that shows the sky, a road and a car."""
    ids = np.full((rows, cols), EMPTY, np.uint8)
    ids[rows // 2 :], ids[rows // 2 : rows // 2 + 8, 20:40] = CLASS_ID["road"], CLASS_ID["vehicle_small"]
    return ids


def save_npz(path, voxels: np.ndarray, name: str = "voxels") -> str:
    """Write one array as .npz and return the path."""
    np.savez(path, **{name: voxels})
    return str(path)


def studio_scene(number: int) -> Scene:
    """Return a scene with three cars on ground, on the grid of the tiny pipeline."""
    scene = random_scene(number, 3, grid=small_spec().grid, tilt_rad=0, vegetation_density="low")
    center_m = np.array([[12, 0, 0.5], [30, 4, 0.5], [50, -6, 0.5]], np.float32)
    size_m = np.tile(np.array([[4.2, 1.8, 1.5]], np.float32), (3, 1))
    rotation = np.tile(np.eye(3, dtype=np.float32), (3, 1, 1))
    occupied = np.ones_like(scene.occupied)
    boxes = {
        "center_m": center_m,
        "size_m": size_m,
        "rotation": rotation,
        "category": np.full(3, CATEGORY_INDEX["vehicle_small"], np.int8),
    }
    return replace(scene, scene_id=f"given-{number}", occupied=occupied, label=UNSET, **boxes)


def make_straight_drive(y_m: float = 0.0, kind: str = "car", speed_mps: float = 10.0) -> Tracks:
    """Return a road user that moves along x for 5.5 s."""
    time = np.arange(0, 6.0, 0.5)
    center = np.stack([2 + speed_mps * time, np.full_like(time, y_m), np.full_like(time, 0.75)], axis=1)
    numbers, kinds = np.zeros(len(time), np.int64), np.full(len(time), kind)
    return Tracks(numbers, kinds, time, center, np.zeros_like(time), np.full_like(time, speed_mps))
