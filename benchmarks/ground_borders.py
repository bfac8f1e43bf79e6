"""Compare the ground of decoders: overlap with the truth, roughness of borders and small parts, with noisy latents.

    python benchmarks/ground_borders.py --dataset DIRECTORY [--starts town town-pixels] [--lvae DIRECTORY ...]
    python benchmarks/ground_borders.py --dataset DIRECTORY --generated DIRECTORY --source generated-RUN

The benchmark encodes held-out scenes, adds noise to the latents and decodes them. The unit of the noise is the standard
deviation of each channel in a scene. `--starts` names presets whose ground branch is not trained: it has the linear
start of models/vae/ground.py or level_sets.py, computed from training scenes. The perimeter of a class per area is
compared with that of the real scenes at the same resolution. The number of parts below 1 m2 stands next to that of the
real scenes. Decoding the ground and tracing its polygons are timed as CPU time per scene.

`--generated` measures generated scenes in the same way, next to other real scenes (the ceiling) and their copies with
rough borders (the control). Compare them with reconstructions at noise 0.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
import tyro
from common import describe_machine

from models.lvae import LayoutVAE
from models.presets import LVAE_PRESETS, find_preset
from models.scene import GROUND_CLASSES, Scene
from models.tensors import decode_layout, make_layout_batch, resample_scene_ground
from pipelines.geometry.ground_polygons import build_ground_polygons
from pipelines.metrics.controls import damage_scene
from pipelines.metrics.relations import fuse_ground, measure_borders
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import SceneSubset
from pipelines.training.latents import load_lvae


@dataclass(frozen=True)
class Config:
    dataset: str
    """Dataset directory."""
    lvae: tuple[str, ...] = ()
    """Directories of trained layout VAEs."""
    starts: tuple[str, ...] = ()
    """Presets whose ground branch has its linear start."""
    start_scenes: int = 96
    """Number of training scenes for the linear start."""
    limit: int = 64
    """Number of test scenes, and of scenes per further set."""
    generated: str = ""
    """Directory of generated scenes."""
    source: str = ""
    """Source of these scenes, such as generated-judged."""
    noise: tuple[float, ...] = (0.0, 0.1, 0.3)
    """Noise levels."""
    seed: int = 0
    """Seed of the noise."""


def read_scenes(root: str, source: str, split: str, limit: int) -> list[Scene]:
    """Read evenly spread scenes of a split."""
    selection = SceneSubset(root, source, split, limit, "spread")
    scenes = [scene for shard, rows in selection.shards() for scene in shard.scenes(rows)]
    if not scenes:
        raise SystemExit(f"{root} contains no scenes of source {source!r} and split {split!r}")
    return scenes


def build_start(name: str, dataset: Dataset, scenes: list[Scene]) -> LayoutVAE:
    """Return the layout VAE of a preset with the linear start of its ground branch."""
    preset = find_preset(LVAE_PRESETS, name)
    spec = dataset.spec.with_resolution(preset.raster_px)
    torch.manual_seed(0)
    lvae = LayoutVAE(layout=spec.to_dict(), **preset.architecture())
    lvae.init_from_data(make_layout_batch(scenes, spec))
    return lvae.eval()


def resample_truth(scene: Scene, lvae: LayoutVAE) -> Scene:
    """Return the scene with its ground on the grid of the model."""
    height_m, occupied = resample_scene_ground(scene, lvae.spec.ground_classes, lvae.spec.grid)
    return replace(
        scene, ground_classes=lvae.spec.ground_classes, height_m=height_m, occupied=occupied, grid=lvae.spec.grid
    )


def measure_ground(scenes: list[Scene]) -> tuple[np.ndarray, np.ndarray]:
    """Return the total perimeter per total area (1/m), and the mean number of small parts, of each ground class."""
    classes = [fuse_ground(scene)[1] for scene in scenes]
    area = np.array([np.bincount(c[c >= 0], minlength=len(GROUND_CLASSES)) for c in classes])
    found = [measure_borders(c, s.grid.resolution_m) for c, s in zip(classes, scenes, strict=True)]
    perimeter, parts = (np.nan_to_num(np.array(values)) for values in zip(*found, strict=True))
    return (perimeter * area).sum(axis=0) / area.sum(axis=0).clip(1), parts.mean(axis=0)


def compare_sets(real: list[Scene], sets: dict[str, list[Scene]]) -> None:
    """Print one line per set of scenes with the classes of the first real scene."""
    real_perimeter, real_parts = measure_ground(real)
    for name, scenes in sets.items():
        perimeter, parts = measure_ground(scenes)
        columns = perimeter / real_perimeter.clip(1e-9), parts, real_parts
        rows = zip(real[0].ground_classes, *columns, strict=False)
        lines = [f"{known} {ratio:.2f} {small:.2f} ({least:.2f})" for known, ratio, small, least in rows]
        print(f"{name}, {scenes[0].grid.rows} px, {len(scenes)} scenes: {'; '.join(lines)}")


def report(name: str, lvae: LayoutVAE, scenes: list[Scene], config: Config) -> None:
    """Print one line per noise level."""
    truth = [resample_truth(scene, lvae) for scene in scenes]
    real_perimeter, real_parts = measure_ground(truth)
    latents = [lvae.encode(make_layout_batch([scene], lvae.spec)).mean for scene in scenes]
    for noise in config.noise:
        generator = torch.Generator().manual_seed(config.seed)
        decoded = []
        for scene, latent in zip(truth, latents, strict=True):
            noisy = torch.randn(latent.shape, generator=generator) * latent.std(dim=(2, 3), keepdim=True) * noise
            decoded.append(decode_layout(lvae.decode(latent + noisy).layouts()[0], lvae.spec, scene))
        both = sum((a.occupied & b.occupied).sum(axis=(1, 2)) for a, b in zip(decoded, truth, strict=True))
        either = sum((a.occupied | b.occupied).sum(axis=(1, 2)) for a, b in zip(decoded, truth, strict=True))
        perimeter, parts = measure_ground(decoded)
        columns = both / either.clip(1), perimeter / real_perimeter.clip(1e-9), parts, real_parts
        rows = zip(lvae.spec.ground_classes, *columns, strict=False)  # Sources without crossings have fewer classes.
        lines = [f"{known} {iou:.3f} {ratio:.2f} {small:.2f} ({least:.2f})" for known, iou, ratio, small, least in rows]
        print(f"{name}, {lvae.spec.grid.rows} px, noise {noise}: {'; '.join(lines)}")
    seconds: dict[str, list[float]] = {"decode ground": [], "polygons": []}
    for latent, scene in zip(latents, truth, strict=True):
        start = time.process_time()
        lvae.decode_ground(lvae.split(latent)[0])
        seconds["decode ground"].append(time.process_time() - start)
        start = time.process_time()
        build_ground_polygons(scene)
        seconds["polygons"].append(time.process_time() - start)
    print(f"{name}:", ", ".join(f"{what} {1e3 * statistics.median(v):.1f} ms" for what, v in seconds.items()))


@torch.no_grad()
def main(config: Config) -> None:
    torch.set_num_threads(1)
    dataset = Dataset.open(config.dataset)
    scenes = read_scenes(dataset.root, dataset.source, "test", config.limit)
    print(describe_machine(), f"{len(scenes)} scenes")
    print("per class: IoU, perimeter per area relative to the real one, small parts per scene (of real scenes)")
    models = {f"start of {name}": name for name in config.starts}
    first = read_scenes(dataset.root, dataset.source, "train", config.start_scenes) if models else []
    for title, name in models.items():
        report(title, build_start(name, dataset, first), scenes, config)
    for directory in config.lvae:
        report(directory, load_lvae(directory).eval(), scenes, config)
    if config.generated:
        generated = read_scenes(config.generated, config.source, "generated", config.limit)
        other = read_scenes(dataset.root, dataset.source, "train", config.limit)
        rough = [damage_scene("ground_roughened", scene, scene, (k,)) for k, scene in enumerate(other)]
        print("per class: perimeter per area relative to the real one, small parts per scene (of real scenes)")
        compare_sets(scenes, {config.source: generated, "other real scenes (ceiling)": other, "rough (control)": rough})


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
