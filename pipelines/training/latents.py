"""Encode scenes to latents with a Ray Data graph; each actor holds a model and writes one shard of latents per task."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pyarrow as pa
import torch

from models.composition.inpaint import find_region_cells
from models.composition.road_sketch import ROAD, SIDEWALK, TERRAIN, keep_streets
from models.lvae import LayoutVAE
from models.tensors import make_layout_batch
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_actors
from pipelines.runtime.resources import find_device
from pipelines.schema.columns import make_latents_schema, make_street_latents_schema
from pipelines.schema.dataset import Dataset
from pipelines.schema.ground_surface import to_model_surface
from pipelines.schema.tables import Shard, find_shards


def digest_weights(model: torch.nn.Module) -> str:
    """Return the first twelve hexadecimal digits of a hash of the weights of a model.

    The digest also tells whether a layout VAE has a local frame, which changes latents but no weights.
    """
    digest = hashlib.sha256(b"local_frame" if getattr(model, "local_frame", None) else b"")
    for name, value in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:12]


def load_lvae(directory: str) -> LayoutVAE:
    """Load a layout VAE. Raises ValueError if the directory does not contain a layout VAE."""
    try:
        return LayoutVAE.from_pretrained(directory).requires_grad_(False)
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{directory}: no layout VAE here ({error}); run jobs/train_lvae.py first") from error


class Encoder:
    """Actor that encodes scenes and writes latents, one shard per row.

    The input row holds the number of a shard. The output row holds the sums of the latent means of the shard, per
    channel.
    """

    def __init__(
        self, lvae: str, output: str, shards: list[Shard], there: set[str], batch_size: int, streets: bool
    ) -> None:
        self.model, self.output, self.shards, self.batch_size = load_lvae(lvae), output, shards, batch_size
        self.streets = streets
        self.there = there  # Files of an interrupted run.
        self.device = find_device()
        self.model.to(self.device)

    @torch.no_grad()
    def encode(self, shard: Shard) -> tuple[list[str], np.ndarray, np.ndarray]:
        """Return the scene ids of a shard, and latent means and log-variances, each float16 (n, c, h, w)."""
        spec = self.model.spec
        scenes = [to_model_surface(scene, spec) for scene in shard.scenes()]
        parts = []
        for start in range(0, len(scenes), self.batch_size):
            posterior = self.model.encode(
                make_layout_batch(scenes[start : start + self.batch_size], spec).to(self.device)
            )
            parts.append([v.half().cpu().numpy() for v in (posterior.mean, posterior.logvar)])
        mean, logvar = (np.concatenate(group) for group in zip(*parts, strict=True))
        return [scene.scene_id for scene in scenes], mean, logvar

    @torch.no_grad()
    def encode_streets(self, shard: Shard) -> pa.Table:
        """Return the rows of the table street_latents of a shard."""
        spec = self.model.spec
        scenes = [to_model_surface(scene, spec) for scene in shard.scenes()]
        channels, size, _ = self.model.latent_shape
        grounds, cells = [], []
        for start in range(0, len(scenes), self.batch_size):
            kept = [keep_streets(scene) for scene in scenes[start : start + self.batch_size]]
            batch = make_layout_batch([scene for scene, _ in kept], spec).to(self.device)
            grounds.append(self.model.encode(batch).mean[:, : channels // 2].half().cpu().numpy())
            cells += [~find_region_cells(~paved, size) for _, paved in kept]
        tensors = (np.concatenate(grounds), np.stack(cells).astype(np.uint8))
        ids = pa.array([scene.scene_id for scene in scenes])
        columns = [pa.FixedShapeTensorArray.from_numpy_ndarray(values) for values in tensors]
        return pa.table([ids, *columns], schema=make_street_latents_schema(tensors[0].shape[1:]))

    def __call__(self, row: dict) -> dict:
        shard = self.shards[row["id"]]
        target = Shard(self.output, shard.source, shard.split, shard.number)
        if self.streets and target.path("street_latents") not in self.there:
            storage.write_parquet(self.encode_streets(shard), target.path("street_latents"))
        mean = None
        if target.path("latents") in self.there:
            with suppress(ValueError):  # A damaged file is written again.
                mean = target.read("latents", ["mean"])["mean"].combine_chunks().to_numpy_ndarray()
        if mean is None:
            ids, mean, logvar = self.encode(shard)
            tensors = [pa.FixedShapeTensorArray.from_numpy_ndarray(v) for v in (mean, logvar)]
            schema = make_latents_schema(mean.shape[1:])
            storage.write_parquet(pa.table([pa.array(ids), *tensors], schema=schema), target.path("latents"))
        values = mean.astype(np.float64)
        return {
            "id": row["id"],
            "split": shard.split,
            "count": len(mean),
            "sum": values.sum(axis=(0, 2, 3)),
            "square": (values**2).sum(axis=(0, 2, 3)),
            "cells": mean.shape[2] * mean.shape[3],
        }


def encode_latents(
    dataset: Dataset,
    lvae: str,
    output: str,
    num_actors: int = 1,
    batch_size: int = 16,
    on_shard: Callable[[dict], None] | None = None,
    streets: bool = False,
) -> dict:
    """Write latents and latents.json. To resume an interrupted run, call this function again.

    The file latents.json records the LVAE, the digest of its weights, and the channel statistics of the training split.

    Args:
        dataset: Dataset with the scenes to encode.
        lvae: Directory of the layout VAE.
        output: Directory of the latents.
        num_actors: Number of actors; each actor holds a model.
        batch_size: Number of scenes per forward pass.
        on_shard: Called with the row of each finished shard.
        streets: Whether to write the table street_latents, too.

    Returns:
        Content of latents.json.

    Raises:
        ValueError: The layout of the LVAE lacks a category or a ground class of the dataset or covers another area, the
            directory contains latents of another LVAE, or latents of streets are requested although the latents mix
            ground and objects or lack a class.
    """
    model = load_lvae(lvae)
    for note in model.spec.require_cover(dataset.spec, dataset.root):
        print(f"note: {note}")
    if streets and (not model.config.split_latent or {ROAD, SIDEWALK, TERRAIN} - set(model.spec.ground_classes)):
        raise ValueError(f"{lvae} has no separate latent for road, sidewalk and terrain; encode without streets")
    description, digest = storage.join_uri(output, "latents.json"), digest_weights(model)
    if storage.exists(description):
        found = storage.read_json(description)
        if found["lvae_digest"] != digest:
            raise ValueError(f"{output} holds latents of another LVAE ({found['lvae']}); choose another --output")
        if found["complete"] and (found.get("streets") or not streets):
            return found
    content = {"lvae": lvae, "lvae_digest": digest, "dataset": dataset.root, "complete": False}
    content |= {"streets": True} if streets else {}
    storage.write_json(content, description)
    storage.clean_temporaries(storage.join_uri(output, "latents"))

    shards = find_shards(dataset.root, source=dataset.source)
    total: np.ndarray | float = 0.0
    square: np.ndarray | float = 0.0
    cells, counts, promised = 0, {}, {}
    tables = ("latents", "street_latents")[: 1 + streets]
    there = {path for table in tables for path in storage.list_files(storage.join_uri(output, table), ".parquet")}
    arguments = lvae, output, shards, there, batch_size, streets
    for row in map_actors(range(len(shards)), Encoder, arguments, num_actors):
        shard = shards[row["id"]]
        for table in tables:
            promised[Shard(output, shard.source, shard.split, shard.number).path(table)] = int(row["count"])
        counts[row["split"]] = counts.get(row["split"], 0) + int(row["count"])
        if row["split"] == "train":
            total, square = total + row["sum"], square + row["square"]
            cells += int(row["count"]) * int(row["cells"])
        if on_shard:
            on_shard(row)
    storage.require_rows(promised)
    mean = np.asarray(total / cells)
    content |= {
        "complete": True,
        "scenes": counts,
        "shape": list(model.latent_shape),
        "channel_mean": mean.tolist(),
        "channel_std": np.sqrt(np.maximum(square / cells - mean**2, 1e-12)).tolist(),
    }
    storage.write_json(content, description)
    return content
