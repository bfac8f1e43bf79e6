"""Validate on rank 0 during training: compute losses and pictures, always for the same held-out scenes."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import lru_cache, reduce
from operator import add
from typing import cast

import numpy as np
import torch
from scipy.ndimage import label

from models.composition.street_plan import StreetPlan
from models.dit import DiT
from models.lvae import LayoutVAE
from models.sampling.diffusion import Diffusion, SamplingSchedule, SceneNoise, make_keyed_generator, sample
from models.scene import Grid, Scene
from models.street_planner import StreetPlanner
from models.tensors import decode_layout, make_layout_batch
from models.training import Trainer, sample_noise
from models.vae.accuracy import compute_accuracy, join_pairs, pair_primitives
from models.vae.losses import compute_lvae_loss
from pipelines.metrics.reconstruction import (
    compute_detection_scores,
    compute_ground_scores,
    join_matches,
    match_scene,
    sum_ground,
)
from pipelines.rendering.render import arrange_contact_sheet, render_bev
from pipelines.schema.ground_surface import to_model_surface
from pipelines.schema.tables import Shard, find_shards, read_scenes
from pipelines.training.data_loader import LatentReader
from pipelines.training.latents import load_lvae
from pipelines.training.street_map_reader import StreetMapReader
from pipelines.training.voxel_reader import VoxelReader

SHOWN = 4
PLAN_M = 512.0


@lru_cache(maxsize=2)
def load_held_out_scenes(root: str, source: str, count: int) -> tuple[Scene, ...]:
    """Return the first test scenes of a dataset, or training scenes if there is no test split."""
    try:
        return tuple(read_scenes(root, source, "test", count))
    except ValueError:
        return tuple(read_scenes(root, source, "train", count))


@dataclass(frozen=True)
class ReconstructionCheck:
    """Validation of stage 1 on the first `count` held-out scenes."""

    root: str
    source: str
    kl_weight: float
    count: int = 32
    batch: int = 8

    @torch.no_grad()
    def __call__(self, trainer: Trainer) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """Return metrics and pictures.

        Losses are computed from a sampled latent, as in training. Ground IoU, height error and AP3D are computed from
        the mean latent, as in the evaluation. The pictures show the ground truth in the upper row and the
        reconstruction in the lower row.
        """
        model, scenes = (
            cast(LayoutVAE, trainer.ema_model().eval()),
            list(load_held_out_scenes(self.root, self.source, self.count)),
        )
        spec, sums, losses, rebuilt, matches, pairs = model.spec, [], [], [], [], []
        for start in range(0, len(scenes), self.batch):
            chosen = [to_model_surface(scene, spec) for scene in scenes[start : start + self.batch]]
            batch = make_layout_batch(chosen, spec).to(trainer.device)
            generators = [make_keyed_generator(0, start + k) for k in range(len(chosen))]
            (noise,) = sample_noise(generators, model.latent_shape, trainer.device)
            output, posterior = model(batch, noise)
            parts = compute_lvae_loss(output, posterior, batch, spec, self.kl_weight).items()
            losses.append({name: float(value) * len(chosen) for name, value in parts.items()})
            decoded = model.decode(posterior.mean)
            if decoded.branches != "ground":
                pairs.append(pair_primitives(decoded, batch, spec))
            layouts = decoded.layouts()
            for scene, layout, *truth in zip(chosen, layouts, batch.occupied, batch.height, strict=True):
                rebuilt.append(decode_layout(layout, spec, scene))
                matches.append(match_scene(scene, decode_layout(layout, spec, scene, threshold=-1.0)))
                occupied, height = (v.cpu().numpy() for v in truth)
                height_m = [spec.height_bounds_m.restore(h[..., None])[..., 0] for h in (height, layout.height)]
                sums.append(sum_ground(occupied > 0.5, height_m[0], layout.occupancy > 0.5, height_m[1]))
        model.train()
        scores = compute_ground_scores(
            reduce(add, sums), spec.ground_classes, np.array([*spec.height_bounds_m.low, *spec.height_bounds_m.high])
        )
        metrics = {f"validation_{name}": sum(part[name] for part in losses) / len(scenes) for name in losses[0]}
        metrics |= {"validation_ground_iou": scores.iou, "validation_height_rmse_m": scores.height_rmse_m}
        metrics |= {"validation_ap3d": compute_detection_scores(join_matches(matches)).ap3d}
        if pairs and len((joined := join_pairs(pairs)).distance_m):
            metrics |= {f"validation_{name}": value for name, value in asdict(compute_accuracy(joined)).items()}
        pictures = [render_bev(s) for s in (*scenes[:SHOWN], *rebuilt[:SHOWN])]
        return metrics, {"reconstruction": arrange_contact_sheet(pictures, columns=min(SHOWN, len(scenes)))}


@dataclass(frozen=True)
class SamplingCheck:
    """Validation of stage 2: the loss on held-out latents, and scenes that are sampled from the same noise each
    time."""

    root: str
    source: str
    latents: str
    lvae: str
    label: str
    count: int = 64
    num_inference_steps: int = 25
    streets: bool = False

    @torch.no_grad()
    def __call__(self, trainer: Trainer) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """Return the validation loss and pictures of SHOWN generated scenes, with the same noise at each validation."""
        dit, device = cast(DiT, trainer.ema_model().eval()), trainer.device
        arrays = load_held_out_latents(self.root, self.source, self.latents, self.label, self.count, self.streets)
        arrays = {name: torch.from_numpy(value).to(device) for name, value in arrays.items()}
        generators = [make_keyed_generator(1, k) for k in range(len(arrays["label"]))]
        loss = float(trainer.loss(dit, arrays, generators)["loss"])

        shape = (dit.config.channels, dit.config.size, dit.config.size)
        labels = torch.arange(SHOWN, device=device) % dit.config.num_labels
        latents = sample(
            dit,
            SamplingSchedule(Diffusion(), self.num_inference_steps),
            SceneNoise(0, range(SHOWN), shape, device),
            labels,
        )
        shift, scale = (
            torch.tensor(v or [d] * shape[0], device=device)[:, None, None]
            for v, d in ((dit.config.shift, 0.0), (dit.config.scale, 1.0))
        )
        dit.train()
        lvae = load_cached_lvae(self.lvae).to(device)
        identity = load_held_out_scenes(self.root, self.source, 1)[0]
        scenes = [decode_layout(x, lvae.spec, identity) for x in lvae.decode(latents * scale + shift).layouts()]
        return {"validation_loss": loss}, {
            "samples": arrange_contact_sheet([render_bev(s) for s in scenes], columns=SHOWN)
        }


@dataclass(frozen=True)
class StreetPlanCheck:
    """Validation of a street planner: the loss on held-out street maps, and a plan of PLAN_M x PLAN_M."""

    shards: list[Shard]
    reader: StreetMapReader
    count: int = 64

    @torch.no_grad()
    def __call__(self, trainer: Trainer) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """Return the validation loss, the share of road in the largest connected part of a plan, and its picture."""
        planner = cast(StreetPlanner, trainer.ema_model().eval())
        rows = np.arange(min(self.count, self.shards[0].read("street_maps", ["map_id"]).num_rows))
        arrays = {name: torch.from_numpy(v).to(trainer.device) for name, v in self.reader(self.shards[0], rows).items()}
        loss = float(trainer.loss(planner, arrays, [make_keyed_generator(1, k) for k in rows.tolist()])["loss"])
        side = round(PLAN_M)
        road, paved = StreetPlan(planner).draw(Grid(PLAN_M / 2, PLAN_M / 2, 1.0, side, side))
        planner.train()
        parts, _ = cast(tuple[np.ndarray, int], label(road))
        sizes = np.bincount(parts.ravel())[1:]
        scores = {"validation_loss": loss, "validation_road": float(road.mean())}
        scores["validation_connectivity"] = float(sizes.max() / sizes.sum()) if len(sizes) else 0.0
        picture = np.where(road, 255, np.where(paved, 128, 0)).astype(np.uint8)
        return scores, {"plan": picture[:, :, None].repeat(3, axis=2)}


@dataclass(frozen=True)
class HeldOutLoss:
    """Validation of a voxel method: the loss on the first held-out scenes, with the same noise at each validation."""

    shards: list[Shard]
    reader: VoxelReader
    count: int = 16
    batch: int = 4

    @torch.no_grad()
    def __call__(self, trainer: Trainer) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """Return the mean of each part of the loss, and no pictures."""
        model = trainer.ema_model().eval()
        found = self.shards[0].read("voxels", ["scene_id"]).num_rows
        totals: dict[str, float] = {}
        for start in range(0, min(self.count, found), self.batch):
            rows = np.arange(start, min(start + self.batch, self.count, found))
            samples = self.reader(self.shards[0], rows).items()
            arrays = {name: torch.from_numpy(value).to(trainer.device) for name, value in samples}
            losses = trainer.loss(model, arrays, [make_keyed_generator(1, k) for k in rows.tolist()])
            for name, value in losses.items():
                totals[name] = totals.get(name, 0.0) + float(value) * len(rows) / min(self.count, found)
        model.train()
        return {f"validation_{name}": value for name, value in totals.items()}, {}


@lru_cache(maxsize=1)
def load_cached_lvae(directory: str) -> LayoutVAE:
    """Return a layout VAE, which is loaded once per process."""
    return load_lvae(directory)


@lru_cache(maxsize=1)
def load_held_out_latents(
    root: str, source: str, latents: str, label: str, count: int, streets: bool = False
) -> dict[str, np.ndarray]:
    """Return the first latents of the test split, or of the training split if there is no test split.

    Args:
        root: Dataset directory.
        source: Source of the scenes.
        latents: Directory with latents.json.
        label: Kind of label.
        count: Maximum number of scenes.
        streets: Whether to read the latents of the streets, too.

    Returns:
        Posteriors and labels {mean, logvar, label}, and latents of streets.
    """
    try:
        shards = find_shards(root, source=source, split="test")
    except ValueError:
        shards = find_shards(root, source=source, split="train")
    read, parts, left = LatentReader({root: latents}, label, streets), [], count
    for shard in shards:
        rows = np.arange(min(left, shard.read("scenes", ["scene_id"]).num_rows))
        parts.append(read(shard, rows))
        left -= len(rows)
        if left == 0:
            break
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
