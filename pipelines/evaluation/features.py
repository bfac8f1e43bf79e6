"""Compute features of scenes, or of the pictures of an .npz, for the scores, with a Ray Data graph.

Each part is written as a Parquet file with one row per scene. FEATURE_TYPES lists the columns. Finished parts are kept.
An interrupted run therefore resumes with the missing parts.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import pyarrow as pa
import torch

from models.scene import Scene
from models.tensors import resample_scene_ground
from pipelines.metrics import distributions, inception, lite0, statistics, validity, vgg16
from pipelines.metrics.adm_npz import iterate_pictures
from pipelines.metrics.controls import damage_scene
from pipelines.metrics.relations import fuse_ground, measure_objects, summarise_relations
from pipelines.rendering.render import render_bev
from pipelines.runtime import storage
from pipelines.runtime.ray_tasks import map_actors, map_tasks
from pipelines.schema.dataset import Dataset
from pipelines.schema.run_guard import guard_options
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard

READER_CPUS = 0.5
PICTURES_PER_PART = 512
VERSION = 2  # Version of the features; files with another version are computed again.
PLACE_M = 128.0
PICTURE_PX = 256  # Paper, Sec. 4.1, Metrics.
# Types of the numbers in each column except scene_id and place. A column contains one list of numbers per scene.
FEATURE_TYPES = {
    "statistics": np.float64,
    "histograms": np.uint32,
    "relations": np.float64,
    "relation_histograms": np.uint32,
    "validity": np.float64,
    "category_validity": np.float64,
    "fidelity": np.float64,
    "random": np.float32,
    "lite0": np.float32,
    "pool3": np.float32,
    "spatial": np.float32,
    "logits": np.float32,
    "vgg16": np.float32,
    "blank": np.uint8,
}


@dataclass(frozen=True)
class FeatureConfig:
    """Options that determine the features.

    Attributes:
        supersample: Number of points per pixel along each axis; a pixel is the mean of its points.
        inception: File with the Inception weights; "" means no Inception features.
        lite0: File with the converted weights of EfficientNet-Lite0 (lite0.py); "" means no such features.
        control: Damage to apply to each scene before its features are computed (controls.py); "" means none.
        vgg16: File with the weights of VGG16 (vgg16.py); "" means no such features.
        random: Whether to compute the features of the random network.
        blank: Whether to mark pictures that the PDD protocol drops (`find_blank_pictures`).
    """

    supersample: int = 1
    inception: str = ""
    lite0: str = ""
    control: str = ""
    vgg16: str = ""
    random: bool = True
    blank: bool = False


@dataclass(frozen=True)
class ImageFile:
    """The first `limit` pictures of an .npz in ADM's format."""

    path: str
    limit: int

    @property
    def root(self) -> str:
        """Return the path of the file."""
        return self.path


SceneSet = SceneSubset | ImageFile  # One side of a comparison.


def count_scenes(side: SceneSet) -> int:
    """Return the number of scenes of a side; 0 if a subset is empty."""
    if isinstance(side, ImageFile):
        return side.limit
    try:
        return sum(len(rows) for _, rows in side.shards())
    except ValueError:
        return 0


def compute_features(pictures: np.ndarray, looks: FeatureConfig) -> dict[str, np.ndarray]:
    """Compute the features of pictures (n, H, W, 3) uint8 that the options name; each is an array (n, width)."""
    named = {"random": inception.compute_random_features(pictures)} if looks.random else {}
    if looks.blank:
        named["blank"] = find_blank_pictures(pictures)[:, None]
    if looks.vgg16:
        network = load_cached_vgg16(*storage.fingerprint_file(looks.vgg16))
        named["vgg16"] = vgg16.compute_vgg16_features(network, pictures)
    if looks.lite0:
        named["lite0"] = lite0.compute_lite0_features(load_cached_lite0(looks.lite0), pictures)
    if looks.inception:
        network = load_cached_inception(*storage.fingerprint_file(looks.inception))
        named |= inception.compute_inception_features(network, pictures)._asdict()
    return named


def find_blank_pictures(pictures: np.ndarray) -> np.ndarray:
    """Return which pictures (n, H, W, 3) the PDD fork drops: entirely white, or with any pixel of pure black."""
    is_white = (pictures == 255).all(axis=(1, 2, 3))
    has_black = (pictures == 0).all(axis=3).any(axis=(1, 2))
    return is_white | has_black


def drop_blank(described: StoredFeatures) -> tuple[StoredFeatures, int]:
    """Drop the scenes with a mark in the column `blank`.

    Args:
        described: Features of all scenes of a side.

    Returns:
        Features of the other scenes, with the column `row` (n,), the position of each scene in the side; and the number
        of dropped scenes.
    """
    blank = described["blank"][:, 0]
    kept = np.flatnonzero(blank == 0)
    return replace(described, rows=kept), len(blank) - len(kept)


def compute_scene_rows(scenes: list[Scene], dataset: Dataset) -> dict[str, np.ndarray]:
    """Compute layout statistics, relations, histograms, validity and label fidelity of scenes of a dataset."""
    slab_offset_m = dataset.spec.slab_offset_m
    rows: dict[str, list[np.ndarray]] = defaultdict(list)
    for scene in scenes:
        classes = dataset.spec.ground_classes
        height, occupied = resample_scene_ground(scene, classes, scene.grid)
        scene = replace(scene, ground_classes=classes, height_m=height, occupied=occupied)
        rows["statistics"].append(statistics.compute_layout_statistics(scene))
        rows["histograms"].append(distributions.compute_scene_histograms(scene))
        height_m, ground_class = fuse_ground(scene)
        objects = measure_objects(scene, slab_offset_m, height_m, ground_class)
        relations = summarise_relations(scene, objects, ground_class)
        rows["relations"].append(relations.vector)
        rows["relation_histograms"].append(relations.histograms)
        by_category, connectivity = validity.compute_category_validity(scene, slab_offset_m, objects)
        rows["validity"].append(validity.sum_validity(by_category, connectivity).ravel())
        rows["category_validity"].append(by_category.ravel())
        rows["fidelity"].append(judge_labels(scene, dataset).ravel())
    return {name: np.stack(values) for name, values in rows.items()}


def judge_labels(scene: Scene, dataset: Dataset | None) -> np.ndarray:
    """Return the label fidelity (3, 2) of a scene.

    All entries are zero if the scene has no label or the dataset is None.
    """
    if dataset is None or (scene.vegetation_density is None and scene.vehicle_density is None):
        return np.zeros((len(validity.LABEL_MEASURES), 2))
    return validity.compute_label_fidelity(scene, dataset.vegetation, dataset.vehicle)


def compute_part(
    number: int, parts: list[tuple[Shard, list[int]]], dataset: Dataset | None, looks: FeatureConfig, directory: str
) -> dict:
    """Compute and write the features of some rows of a shard in a Ray task; return the number of scenes."""
    torch.set_num_threads(1)
    shard, rows = parts[number]
    scenes = shard.scenes(rows)
    if looks.control:
        scenes = damage_scenes(scenes, number, parts, looks.control)
    pictures = np.stack([render_bev(scene, PICTURE_PX, looks.supersample) for scene in scenes])
    columns = compute_features(pictures, looks)
    if dataset:
        columns = compute_scene_rows(scenes, dataset) | columns
    names, places = [scene.scene_id for scene in scenes], [find_place(scene) for scene in scenes]
    write_part(directory, number, names, places, columns)
    return {"scenes": len(scenes)}


def damage_scenes(scenes: list[Scene], number: int, parts: list[tuple[Shard, list[int]]], control: str) -> list[Scene]:
    """Damage the scenes of a part. Each scene has a donor in the part that is half the list of parts away.

    If there is only one part, the donor is half the part away.
    """
    shard, rows = parts[(number + max(1, len(parts) // 2)) % len(parts)]
    shift = len(rows) // 2 if len(parts) == 1 else 0
    donors = shard.scenes([rows[(k + shift) % len(rows)] for k in range(len(scenes))])
    return [
        damage_scene(control, scene, donor, (number, k))
        for k, (scene, donor) in enumerate(zip(scenes, donors, strict=True))
    ]


@lru_cache(maxsize=1)
def load_cached_lite0(path: str) -> lite0.Lite0:
    """Load EfficientNet-Lite0 once per process; the name of the file contains the digest of the weights."""
    return lite0.load_lite0(path)


@lru_cache(maxsize=1)
def load_cached_inception(path: str, *_: str | int) -> inception.Inception:
    """Load the Inception network; the cache uses the fingerprint of the file as key."""
    return inception.load_inception(path)


@lru_cache(maxsize=1)
def load_cached_vgg16(path: str, *_: str | int) -> vgg16.VGG16:
    """Load VGG16; the cache uses the fingerprint of the file as key."""
    return vgg16.load_vgg16(path)


class ImageFeatureExtractor:
    """Actor that computes and writes the features of one part: a range of pictures of an .npz.

    The input row holds the number of the part. The output row holds the number of pictures in the part. An actor reads
    the file in order and skips the parts that other actors compute. To go back to an earlier part, the actor starts
    again at the beginning of the file.
    """

    def __init__(self, path: str, parts: list[range], looks: FeatureConfig, directory: str) -> None:
        torch.set_num_threads(1)
        self.path, self.parts, self.directory, self.looks = path, parts, directory, looks
        self.batches, self.next_part = iter(()), len(parts)

    def __call__(self, row: dict) -> dict:
        number = row["id"]
        if number < self.next_part:
            self.batches, self.next_part = iterate_pictures(self.path, PICTURES_PER_PART), 0
        while self.next_part <= number:
            pictures = next(self.batches)
            self.next_part += 1
        part = self.parts[number]
        names = [f"{index:07d}" for index in part]
        write_part(self.directory, number, names, names, compute_features(pictures[: len(part)], self.looks))
        return {"scenes": len(part)}


def make_part_path(directory: str, number: int) -> str:
    """Return the path of a part's file."""
    return storage.join_uri(directory, f"part-{number:05d}.parquet")


def find_place(scene: Scene) -> str:
    """Return the name of the place of a scene. Real scenes of one place look alike, so tests keep them together.

    A place is a square of PLACE_M in the world frame of a drive; its name begins with the drive. Each generated scene
    is a place of its own.
    """
    if scene.split == "generated":
        return scene.scene_id
    x, y = (int(value // PLACE_M) for value in scene.world_xyz_m[:2])
    return f"{scene.source}/{scene.sequence}/{x}/{y}"


def write_part(
    directory: str, number: int, scene_ids: list[str], places: list[str], columns: dict[str, np.ndarray]
) -> None:
    """Write the file of a part: one row per scene, with scene id, place and one list of numbers per column."""
    arrays = {"scene_id": pa.array(scene_ids, pa.string()), "place": pa.array(places, pa.string())}
    for name, values in columns.items():
        flat = pa.array(np.ascontiguousarray(values, FEATURE_TYPES[name]).ravel())
        arrays[name] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    storage.write_parquet(pa.table(arrays), make_part_path(directory, number))


@dataclass(frozen=True)
class FeatureParts:
    """Files with the features of a side, one per part.

    Attributes:
        directory: Directory of the files.
        count: Number of parts.
    """

    directory: str
    count: int

    def list_columns(self) -> list[str]:
        """Return the names of the columns with numbers."""
        return storage.read_parquet(make_part_path(self.directory, 0)).column_names[2:]

    def iterate_column(self, name: str) -> Iterator[np.ndarray]:
        """Yield a column (n, width) part by part; only one part is in memory."""
        for number in range(self.count):
            yield read_column(storage.read_parquet(make_part_path(self.directory, number), [name]), name)

    def open(self) -> StoredFeatures:
        """Return a mapping from the name of a column to its values. A column is read when it is used."""
        return StoredFeatures(self)

    def read(self) -> dict[str, np.ndarray]:
        """Read all parts in order; return scene_id (n,), place (n,) and the other columns (n, width)."""
        return dict(self.open())


@dataclass(frozen=True, eq=False)
class StoredFeatures(Mapping[str, np.ndarray]):
    """Features of a side, by name of the column. Each access reads a column, so that a process holds only what it uses.

    Attributes:
        parts: Files of the features.
        rows: (n,) positions of the scenes to keep. None: all scenes. If it is given, it is also the column `row`.
    """

    parts: FeatureParts
    rows: np.ndarray | None = None

    @cached_property
    def _names(self) -> tuple[str, ...]:
        names = storage.read_parquet(make_part_path(self.parts.directory, 0)).column_names
        return (*names, *(("row",) if self.rows is not None else ()))

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._names:
            raise KeyError(name)
        if name == "row" and self.rows is not None:
            return self.rows
        if name in ("scene_id", "place"):
            paths = [make_part_path(self.parts.directory, number) for number in range(self.parts.count)]
            values = np.concatenate([storage.read_parquet(path, [name])[name].to_numpy() for path in paths])
        else:
            values = np.concatenate(list(self.parts.iterate_column(name)))
        return values if self.rows is None else values[self.rows]

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def read_column(table: pa.Table, name: str) -> np.ndarray:
    """Return a column of lists of numbers as an array (n, width)."""
    return table[name].combine_chunks().flatten().to_numpy().reshape(len(table), -1)


def compute_scene_features(
    side: SceneSet,
    dataset: Dataset | None,
    looks: FeatureConfig,
    directory: str,
    num_actors: int = 1,
    on_scenes: Callable[[int], None] | None = None,
) -> FeatureParts:
    """Compute the features of each scene of a side and write one file per part.

    If `directory` already contains the file of a part, the function reads this file. For scenes, a part is a shard and
    is computed by one Ray task. For an .npz, a part has PICTURES_PER_PART pictures and is computed by one actor call.

    Args:
        side: Scenes, or pictures of an .npz.
        dataset: Dataset with the ground classes and the thresholds of density labels. None: only picture features are
            computed, as for an .npz.
        looks: Options that determine the features.
        directory: Directory with one Parquet file per part. Files that belong to another side or to other options are
            deleted.
        num_actors: Maximum number of concurrent tasks or actors.
        on_scenes: Called with the number of scenes of each finished part.

    Returns:
        The files, in the order of the shards or pictures.
    """
    ranges: list[range] = []
    shards: list[tuple[Shard, list[int]]] = []
    if isinstance(side, ImageFile):
        ranges = [range(at, min(at + PICTURES_PER_PART, side.limit)) for at in range(0, side.limit, PICTURES_PER_PART)]
        counts, files, judged_by = [len(part) for part in ranges], [storage.fingerprint_file(side.path)], None
    else:
        shards = side.shards()
        counts = [len(rows) for _, rows in shards]
        tables = ("scenes", "primitives", "rasters")
        files = storage.fingerprint_files([shard.path(table) for shard, _ in shards for table in tables])
        judged_by = dataset and [asdict(dataset.vegetation), asdict(dataset.vehicle), list(dataset.spec.ground_classes)]
    guard_options(
        storage.join_uri(directory, "described.json"),
        {"side": asdict(side), "files": files, "labels": judged_by} | make_options_record(looks),
        is_in_use=lambda: False,
        discard=lambda: storage.delete_directory(directory),
        describe=str,
    )
    promised = {make_part_path(directory, number): count for number, count in enumerate(counts)}
    faulty = storage.find_faulty_files(promised)
    missing = [number for number, path in enumerate(promised) if path in faulty]
    if on_scenes:
        on_scenes(sum(counts) - sum(counts[number] for number in missing))

    def describe_scenes(number: int) -> dict:
        return compute_part(number, shards, dataset, looks, directory)

    if isinstance(side, ImageFile):
        arguments = side.path, ranges, looks, directory
        rows = map_actors(missing, ImageFeatureExtractor, arguments, num_actors, READER_CPUS, uses_gpu=False)
    else:
        rows = map_tasks(describe_scenes, missing, READER_CPUS, num_actors)
    for row in rows:
        if on_scenes:
            on_scenes(row["scenes"])
    storage.require_rows(promised)
    return FeatureParts(directory, len(counts))


def load_scenes(parts: list[tuple[Shard, list[int]]], indices: np.ndarray) -> list[Scene]:
    """Load the scenes at `indices` of a selection, in this order."""
    counts = np.array([len(rows) for _, rows in parts])
    starts = np.cumsum(counts) - counts
    scenes = {}
    for number in np.unique(np.searchsorted(starts, indices, side="right") - 1):
        shard, rows = parts[number]
        wanted = np.unique(indices[(indices >= starts[number]) & (indices < starts[number] + len(rows))])
        for index, scene in zip(wanted, shard.scenes([rows[i - starts[number]] for i in wanted]), strict=True):
            scenes[index] = scene
    return [scenes[index] for index in indices]


def make_options_record(looks: FeatureConfig) -> dict:
    """Return the options that determine the features. A hash of the weights replaces the name of their file.

    Options that version 0.2 added are recorded only if they differ from the default, so earlier features are kept.
    """
    record = asdict(looks) | {
        "version": VERSION,
        "lite0": looks.lite0.rsplit("/", 1)[-1],  # The name contains the digest.
        "inception": inception.hash_inception_weights(looks.inception) if looks.inception else "",
        "vgg16": vgg16.hash_vgg16_weights(looks.vgg16) if looks.vgg16 else "",
    }
    unchanged = {"vgg16": "", "random": True, "blank": False}
    return {name: value for name, value in record.items() if name not in unchanged or value != unchanged[name]}
