"""Convert scenes to and from Parquet tables; real and generated scenes share this schema.

A dataset directory holds the tables `scenes/`, `primitives/`, `rasters/`, `latents/` and `rejects/`. Each table is
partitioned in Hive style: `source=.../split=.../part-<shard>.parquet`. Part k of every table holds the same scenes in
the same order. A reader therefore needs no join. Column names contain units. The metadata of every file describes the
columns. docs/reference/tables.md documents the tables for users.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from models.geometry.cholesky import compute_cholesky_parameters
from models.limits import LimitError
from models.scene import CATEGORIES, CATEGORY_INDEX, ELLIPSOID, GROUND_CLASSES, VEGETATION, VEHICLES, Grid, Scene
from models.uris import split_options
from pipelines.runtime import storage
from pipelines.schema.validation import encode_texts, validate_shard, validate_table

logger = logging.getLogger(__name__)

TABLES = ("scenes", "primitives", "rasters", "edits", "rejects")
SCENE_TABLES = ("scenes", "primitives", "rasters")  # Tables that every shard has.
TEXTS = ("scene_id", "category", "label", "kind")  # Text columns of the table `primitives`.
SCHEMA_VERSION = "1"  # Version of the column names and types. Descriptions may change within a version.
DEFAULTS = {"free_pose": "false"}  # JSON value of columns that earlier versions did not write.
HEIGHT_STEP_M = 0.01
MAX_HEIGHT_M = 32767 * HEIGHT_STEP_M  # Largest height (m) that a 16-bit integer can store.

# Meanings of the categories and ground classes, used in the descriptions of columns.
# fmt: off
CATEGORY_MEANING = {
    "vegetation_cuboid":    "trees, bushes and hedges annotated as boxes",
    "vegetation_ellipsoid": "trees and bushes annotated as ellipsoids",
    "vehicle_big":          "trucks, buses and trams",
    "vehicle_small":        "cars and trailers",
    "two_wheelers":         "bicycles and motorcycles",
    "human":                "pedestrians and riders",
    "construction_big":     "buildings and garages",
    "construction_small":   "walls, fences, guard rails and gates",
    "pole":                 "poles and bollards",
    "traffic_control":      "traffic lights, traffic signs and street lamps",
    "object":               "bins, boxes, cones and other small objects",
}
GROUND_MEANING = {
    "road":     "carriageway, or drivable area (av2)",
    "sidewalk": "sidewalks",
    "parking":  "parking areas and driveways",
    "terrain":  "grass, soil and similar surfaces",
    "ground":   "ground of any other kind",
    "crossing": "pedestrian crossings on the road",
}
# fmt: on


def _make_schema(description: str, *columns: tuple[str, pa.DataType, str, str]) -> pa.Schema:
    """Make a self-describing schema from rows of (name, type, unit, description); the unit "" means dimensionless.

    Every field has the metadata `unit` and `description`. DuckDB does not show field metadata. The metadata of the
    table therefore repeats the rows as JSON under `pritti_columns`. DEFAULTS gives the value of columns that earlier
    versions did not write.
    """
    fields, rows = [], []
    for name, kind, unit, meaning in columns:
        about = {"description": meaning} | ({"unit": unit} if unit else {})
        if name in DEFAULTS:
            about[storage.DEFAULT.decode()] = DEFAULTS[name]
        fields.append(pa.field(name, kind, metadata=about))
        rows.append({"name": name, "unit": unit or None, "description": meaning})
    metadata = {
        "pritti_schema_version": SCHEMA_VERSION,
        "pritti_description": description,
        "pritti_columns": json.dumps(rows, ensure_ascii=False),
    }
    return pa.schema(fields, metadata)


# fmt: off
_FRAME = (
    "Scene frame: origin at the ego vehicle, x forward, y left, z up along gravity. Angles are "
    "counter-clockwise from x, seen from above."
)
_SCENE_ID = ("scene_id", pa.string(), "", "Name of the scene, unique within a dataset directory; key of all tables.")
_SEQUENCE = ("sequence", pa.string(), "",
             "Drive of the scene: KITTI-360 drive, Argoverse 2 log, town or own folder; for sampled scenes, the "
             "seed.")

SCENES = _make_schema(
    "One row per scene: labels and totals of a crop of the world ahead of one ego pose (64 x 64 m unless "
    "extended). " + _FRAME,
    _SCENE_ID,
    _SEQUENCE,
    ("frame",                pa.int64(),   "1; av2: ns",
     "Frame number (av2: timestamp), ascending along the drive; for generated scenes, the index within the run."),
    ("x_m",                  pa.float64(), "m",
     "x of the scene's origin in the world frame. kitti360 has one world frame, av2 has one per city, and other "
     "sources have one per sequence."),
    ("y_m",                  pa.float64(), "m",
     "y of the scene's origin in the world frame; the origin of a sampled scene is (0, 0, 0)."),
    ("z_m",                  pa.float64(), "m",
     "z (up) of the scene's origin in the world frame. This is the height of the vehicle's origin, not of the road."),
    ("yaw_rad",              pa.float64(), "rad",
     "Angle from the world's x axis to the scene's x axis, in [-pi, pi]."),
    # A list of variable size, because Parquet has no null value for a list of fixed size.
    ("world_from_imu",       pa.list_(pa.float64()), "1; m",
     "Full pose in the source dataset, a 3 x 4 matrix row by row with the translation (m) in its last column; or "
     "null."),
    ("free_pose",            pa.bool_(),   "",
     "Whether the scene is a crop at any place and heading (town of version 2); false for the view of a vehicle and "
     "in files of earlier versions."),
    ("vegetation_density",   pa.string(),  "",
     "low, medium or high, by number and volume of vegetation; for generated scenes, the requested label or null."),
    ("vehicle_density",      pa.string(),  "",
     "low, medium or high, by number and volume of big and small vehicles; for generated scenes, the requested label "
     "or null."),
    ("vegetation_volume_m3", pa.float64(), "m3",
     "Sum of the volumes of all vegetation primitives; overlapping volume counts once per primitive."),
    ("vehicle_volume_m3",    pa.float64(), "m3",  "Sum of the volumes of all big and small vehicles."),
    ("num_primitives",       pa.int32(),   "1",   "Number of primitives of all categories."),
    *[(f"num_{name}",        pa.int32(),   "1",
       f"Number of {name} primitives: {CATEGORY_MEANING[name]}.")
      for name in CATEGORIES],
    *[(f"{name}_area_m2",    pa.float64(), "m2",
       f"Area of {name} seen from above: {GROUND_MEANING[name]}; null if the scene's source lacks this class.")
      for name in GROUND_CLASSES],
    ("primitive_offset",     pa.int64(),   "1",
     "Row (from 0) of the scene's first primitive in the primitives file of the same part."),
)

PRIMITIVES = _make_schema(
    "One row per primitive and scene: a cuboid or ellipsoid whose centre lies in the scene. An object that "
    "several scenes contain has one row per scene. " + _FRAME,
    _SCENE_ID,
    ("category",    pa.string(),  "",    "One of the eleven categories that all sources share."),
    ("label",       pa.string(),  "",
     "Class name in the source dataset; for generated primitives, the category."),
    ("kind",        pa.string(),  "",    "Shape within the bounding box: cuboid or ellipsoid."),
    ("instance_id", pa.int64(),   "",
     "Number of the object in its sequence, or -1; kitti360 and town number static and moving objects separately."),
    ("x_m",         pa.float32(), "m",   "x of the centre in the scene frame: distance ahead of the ego vehicle."),
    ("y_m",         pa.float32(), "m",
     "y of the centre in the scene frame: distance to the left of the ego vehicle."),
    ("z_m",         pa.float32(), "m",
     "z of the centre in the scene frame: height above the scene's origin, not above the ground."),
    ("length_m",    pa.float32(), "m",   "Full extent along the longer of the two axes other than the height axis."),
    ("width_m",     pa.float32(), "m",   "Full extent along the shorter of the two axes other than the height axis."),
    ("height_m",    pa.float32(), "m",   "Full extent along the height axis, the axis closest to vertical."),
    ("yaw_rad",     pa.float32(), "rad", "Direction of the length axis in the scene frame, in [-pi/2, pi/2)."),
    ("heading_rad", pa.float32(), "rad",
     "Direction of travel in the scene frame, in [-pi, pi); null if unknown and for all generated primitives."),
    ("rotation",    pa.list_(pa.float32(), 9), "1",
     "Rotation matrix R, row by row; its columns are the length, width and height axes in the scene frame."),
    ("cholesky",    pa.list_(pa.float32(), 6), "m^0.5",
     "Cholesky factor of the scatter matrix R diag(length, width, height) R^T: the lower triangle, row by row."),
    ("existence",   pa.float32(), "1",
     "Existence probability in [0, 1]; 1 for annotated primitives."),
)

RASTERS = _make_schema(
    "One row per scene: mask and height of each ground class, as rasters [class, row, col] seen from above. " + _FRAME,
    _SCENE_ID,
    ("height",         pa.binary(),  "height_step_m",
     "z of the ground at each set bit of `occupied`: little-endian int16, stored as differences of successive values."),
    ("occupied",       pa.binary(),  "",
     "One bit per (class, row, col) in C order, most significant first; 1 if the class covers the pixel's centre."),
    ("resolution_m",   pa.float64(), "m",   "Edge length of a pixel."),
    ("height_step_m",  pa.float64(), "m",   "Height that one unit of `height` represents."),
    ("rows",           pa.int32(),   "1",   "Number of pixel rows; row 0 is the farthest ahead."),
    ("cols",           pa.int32(),   "1",   "Number of pixel columns; column 0 is the leftmost."),
    ("front_m",        pa.float64(), "m",
     "x of the far edge in the scene frame; pixel centres lie at x = front_m - (row + 0.5) resolution_m."),
    ("left_m",         pa.float64(), "m",
     "y of the left edge in the scene frame; pixel centres lie at y = left_m - (col + 0.5) resolution_m."),
    ("ground_classes", pa.list_(pa.string()), "", "Names of the ground classes, in the order of the first axis."),
)

REJECTS = _make_schema(
    "One row per reject: a scene that preprocessing excluded, or a drive that preprocessing could not read.",
    ("scene_id", pa.string(), "", "Name of the rejected scene; if frame is null, name of the rejected drive."),
    _SEQUENCE,
    ("frame",    pa.int64(),  "1; av2: ns", "Frame number (av2: timestamp); null if the whole drive is rejected."),
    ("reason",   pa.string(), "", "Reason for the reject."),
)


EDITS = _make_schema(
    "One row per primitive that an edit step changed. The scene_id is the same in the input and the edited "
    "dataset.",
    _SCENE_ID,
    ("step",       pa.int32(),   "1",   "Number of the edit step, from 0; edited-<run>.json lists the steps."),
    ("edit",       pa.string(),  "",    "remove, duplicate, translate, rotate, scale, relabel, snap or repair."),
    ("primitive",  pa.int32(),   "1",   "Number (from 0) of the primitive in the scene before this step."),
    ("change",     pa.string(),  "",    "Effect on the primitive: removed, copied or changed."),
    ("moved_m",    pa.float32(), "m",   "Displacement of the centre; for a copy, the distance from its original."),
    ("turned_rad", pa.float32(), "rad", "Largest angle by which an axis turned; opposite directions count as equal."),
    ("resized",    pa.float32(), "1",   "Largest relative change of length, width or height."),
)


def make_latents_schema(shape: tuple[int, int, int]) -> pa.Schema:
    """Return the schema of the latents table, with the posterior mean and log variance per scene.

    Args:
        shape: (C, h, w) shape of one latent, channels first; values are float16.

    Returns:
        Schema with the columns scene_id, mean and logvar.
    """
    tensor = pa.fixed_shape_tensor(pa.float16(), shape)
    return _make_schema(
        "One row per scene: its latent from the layout VAE that latents.json names. Rows and columns have the "
        "order of the rasters.",
        _SCENE_ID,
        ("mean",   tensor, "1", "Mean of the latent's normal distribution: float16 (channel, row, col), C order."),
        ("logvar", tensor, "1", "Natural logarithm of the latent's variance: float16 (channel, row, col), C order."),
    )


def make_street_latents_schema(shape: tuple[int, int, int]) -> pa.Schema:
    """Return the schema of the table street_latents.

    Args:
        shape: (C, h, w) shape of the ground channels of one latent.

    Returns:
        Schema with the columns scene_id, ground and cells.
    """
    return _make_schema(
        "One row per scene: the latent of its streets without any other content, from the layout VAE that latents.json "
        "names. The ground around the streets is terrain.",
        _SCENE_ID,
        ("ground", pa.fixed_shape_tensor(pa.float16(), shape), "1",
         "Mean of the ground channels of the latent: float16 (channel, row, col), C order."),
        ("cells", pa.fixed_shape_tensor(pa.uint8(), shape[1:]), "",
         "1 for each latent cell (row, col) that lies completely on roads and sidewalks, else 0."),
    )


def make_street_maps_schema(shape: tuple[int, int, int]) -> pa.Schema:
    """Return the schema of the table street_maps.

    Args:
        shape: (C, h, w) shape of the distances of one map.

    Returns:
        Schema.
    """
    return _make_schema(
        "One row per crop of a town at any place and heading, as signed distances to the borders of its streets. "
        "Rows and columns have the order of the rasters; a pixel has a side of 4 m.",
        ("map_id",   pa.string(), "", "Name of the map."),
        _SEQUENCE,
        ("num_vegetation",       pa.int32(),   "1",  "Number of vegetation primitives in the crop."),
        ("vegetation_volume_m3", pa.float64(), "m3", "Sum of the volumes of these primitives."),
        ("num_vehicle",          pa.int32(),   "1",  "Number of big and small vehicles in the crop."),
        ("vehicle_volume_m3",    pa.float64(), "m3", "Sum of the volumes of these vehicles."),
        ("distance_m", pa.fixed_shape_tensor(pa.float16(), shape), "m",
         "Signed distances (channel, row, col) to the border of the roads, and to the border of roads and sidewalks "
         "taken together; positive inside, clipped to 8 m."),
    )
# fmt: on


# ---------------------------------------------------------------------------------------------------- to tables


def encode_ground(scene: Scene) -> tuple[bytes, bytes]:
    """Encode the ground of a scene as the columns `height` and `occupied` of `rasters`.

    Args:
        scene: Scene whose ground heights lie within ±327.67 m.

    Returns:
        (height, occupied) as bytes. Only occupied pixels have a height. Each height is stored as the difference to the
        previous height.

    Raises:
        ValueError: A ground height, in units of HEIGHT_STEP_M, exceeds the range of 16-bit integers.
    """
    steps = np.round(scene.height_m[scene.occupied] / HEIGHT_STEP_M)
    if len(steps) and np.abs(steps).max() > 32767:
        raise ValueError(
            f"scene {scene.scene_id}: ground heights exceed ±327 m, with a maximum of {scene.height_m.max()} m"
        )
    return np.diff(steps.astype("<i2"), prepend=np.int16(0)).tobytes(), np.packbits(scene.occupied).tobytes()


def decode_ground(
    height: bytes, occupied: bytes, shape: tuple[int, int, int], step_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Decode height and mask of the ground from one row of `rasters`.

    Args:
        height: Column `height`.
        occupied: Column `occupied`.
        shape: (G, H, W) number of ground classes, rows and columns.
        step_m: Height of one integer unit, from the column `height_step_m` (m).

    Returns:
        height_m (G, H, W) float32, which is 0 outside the mask; and occupied (G, H, W) bool.
    """
    steps, mask = list_ground_steps(height, occupied, shape)
    height_m = np.zeros(shape, np.float32)
    height_m[mask] = steps * np.float32(step_m)
    return height_m, mask


def list_ground_steps(height: bytes, occupied: bytes, shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Decode one row of `rasters`: the heights of occupied pixels as integers, and the mask.

    Args:
        height: Column `height`.
        occupied: Column `occupied`.
        shape: (G, H, W) number of ground classes, rows and columns.

    Returns:
        Heights of the occupied pixels (m,) int16 in units of height_step_m, and occupied (G, H, W) bool.

    Raises:
        ValueError: The mask does not have one bit per class, row and column.
    """
    if len(occupied) != -(-math.prod(shape) // 8):
        raise ValueError(f"the mask has {len(occupied)} bytes, which does not fit the shape {shape}")
    mask = np.unpackbits(np.frombuffer(occupied, np.uint8), count=np.prod(shape)).view(bool).reshape(shape)
    return np.cumsum(np.frombuffer(height, "<i2"), dtype=np.int16), mask


def _make_scenes_table(scenes: Sequence[Scene]) -> pa.Table:
    counts = np.array([scene.counts() for scene in scenes]).reshape(-1, len(CATEGORIES))
    volumes = [scene.volume_m3 for scene in scenes]

    def volume(group: tuple[int, ...]) -> list[float]:
        return [float(v[np.isin(s.category, group)].sum()) for s, v in zip(scenes, volumes, strict=True)]

    areas = [dict(zip(s.ground_classes, s.ground_area_m2().tolist(), strict=True)) for s in scenes]
    totals = counts.sum(axis=1)
    columns = {
        "scene_id": [s.scene_id for s in scenes],
        "sequence": [s.sequence for s in scenes],
        "frame": [s.frame for s in scenes],
        "x_m": [s.world_xyz_m[0] for s in scenes],
        "y_m": [s.world_xyz_m[1] for s in scenes],
        "z_m": [s.world_xyz_m[2] for s in scenes],
        "yaw_rad": [s.world_yaw_rad for s in scenes],
        "world_from_imu": [None if s.world_from_imu is None else s.world_from_imu.ravel().tolist() for s in scenes],
        "free_pose": [s.free_pose for s in scenes],
        "vegetation_density": [s.vegetation_density for s in scenes],
        "vehicle_density": [s.vehicle_density for s in scenes],
        "vegetation_volume_m3": volume(VEGETATION),
        "vehicle_volume_m3": volume(VEHICLES),
        "num_primitives": totals,
        **{f"num_{name}": counts[:, k] for k, name in enumerate(CATEGORIES)},
        **{f"{name}_area_m2": [area.get(name) for area in areas] for name in GROUND_CLASSES},
        "primitive_offset": np.cumsum(totals) - totals,
    }
    return pa.table(columns, schema=SCENES)


def _make_fixed_lists(values: np.ndarray, width: int) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(np.ascontiguousarray(values, np.float32).reshape(-1)), width)


def make_primitives_table(scenes: Sequence[Scene]) -> pa.Table:
    """Make the rows of `primitives` for several scenes.

    Args:
        scenes: Scenes of one shard; the sequence may be empty.

    Returns:
        One row per primitive, in the order of the scenes.
    """

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(s, name) for s in scenes]) if scenes else np.zeros(0)

    category, heading, yaw = joined("category").astype(np.int8), joined("heading_rad"), joined("yaw_rad")
    center, size = joined("center_m").reshape(-1, 3), joined("size_m").reshape(-1, 3)
    rotation = joined("rotation").reshape(-1, 3, 3)
    names = pa.array(CATEGORIES)
    columns = {
        "scene_id": np.repeat([s.scene_id for s in scenes], [len(s) for s in scenes]),
        "category": names.take(pa.array(category)),
        "label": pa.array(joined("label"), pa.string()),
        "kind": pa.array(["cuboid", "ellipsoid"]).take(pa.array((category == ELLIPSOID).astype(np.int8))),
        "instance_id": joined("instance_id").astype(np.int64),
        **{f"{axis}_m": center[:, k] for k, axis in enumerate("xyz")},
        **{f"{axis}_m": size[:, k] for k, axis in enumerate(("length", "width", "height"))},
        "yaw_rad": yaw,
        "heading_rad": pa.array(heading, mask=np.isnan(heading)),
        "rotation": _make_fixed_lists(rotation, 9),
        "cholesky": _make_fixed_lists(compute_cholesky_parameters(rotation, size), 6),
        "existence": joined("existence"),
    }
    return pa.table(columns).cast(PRIMITIVES)


def _make_rasters_table(scenes: Sequence[Scene]) -> pa.Table:
    encoded = [encode_ground(scene) for scene in scenes]
    columns = {
        "scene_id": [s.scene_id for s in scenes],
        "height": [height for height, _ in encoded],
        "occupied": [occupied for _, occupied in encoded],
        "resolution_m": [s.grid.resolution_m for s in scenes],
        "height_step_m": [HEIGHT_STEP_M] * len(scenes),
        "rows": [s.grid.rows for s in scenes],
        "cols": [s.grid.cols for s in scenes],
        "front_m": [s.grid.front_m for s in scenes],
        "left_m": [s.grid.left_m for s in scenes],
        "ground_classes": [list(s.ground_classes) for s in scenes],
    }
    return pa.table(columns, schema=RASTERS)


def make_scene_tables(scenes: Sequence[Scene]) -> dict[str, pa.Table]:
    """Make the tables of one shard.

    Args:
        scenes: Scenes of the shard.

    Returns:
        Tables `scenes`, `primitives` and `rasters` of the same scenes in the same order.
    """
    return {
        "scenes": _make_scenes_table(scenes),
        "primitives": make_primitives_table(scenes),
        "rasters": _make_rasters_table(scenes),
    }


# -------------------------------------------------------------------------------------------------- from tables


def parse_scenes(
    scenes: pa.Table,
    primitives: pa.Table,
    rasters: pa.Table,
    source: str,
    split: str,
    rows: Sequence[int] | None = None,
) -> Iterator[Scene]:
    """Yield the Scenes of one shard.

    Args:
        scenes: Rows of the shard in the table `scenes`. All three tables are valid (`Shard.read_tables`).
        primitives: Rows of the shard in the table `primitives`.
        rasters: Rows of the shard in the table `rasters`.
        source: Value of the source column.
        split: Value of the split column.
        rows: Row numbers of the scenes to return, in this order (default: all).

    Yields:
        Scene of each row.
    """
    start = 0
    if rows is not None:
        # The arrays of a Scene are views: only the requested rows may stay in memory.
        scenes, rasters = scenes.take(rows), rasters.take(rows)
        spans = zip(scenes["primitive_offset"].to_pylist(), scenes["num_primitives"].to_pylist(), strict=True)
        primitives = pa.concat_tables([primitives.slice(0, 0), *(primitives.slice(*span) for span in spans)])
    fields = _read_primitive_fields(primitives)
    for scene, raster in zip(scenes.to_pylist(), rasters.to_pylist(), strict=True):
        here = slice(start, start + scene["num_primitives"])
        start = here.stop
        grid = Grid(raster["front_m"], raster["left_m"], raster["resolution_m"], raster["rows"], raster["cols"])
        classes = tuple(raster["ground_classes"])
        height, occupied = decode_ground(
            raster["height"], raster["occupied"], (len(classes), grid.rows, grid.cols), raster["height_step_m"]
        )
        pose = scene["world_from_imu"]
        yield Scene(
            scene_id=scene["scene_id"],
            source=source,
            sequence=scene["sequence"],
            frame=scene["frame"],
            split=split,
            ground_classes=classes,
            height_m=height,
            occupied=occupied,
            grid=grid,
            world_xyz_m=(scene["x_m"], scene["y_m"], scene["z_m"]),
            world_yaw_rad=scene["yaw_rad"],
            world_from_imu=None if pose is None else np.array(pose).reshape(3, 4),
            free_pose=scene["free_pose"],
            vegetation_density=scene["vegetation_density"],
            vehicle_density=scene["vehicle_density"],
            **{name: value[here] for name, value in fields.items()},
        )


def find_category_indices(names: pa.ChunkedArray) -> np.ndarray:
    """Return the index of each category name.

    Args:
        names: (n,) category names.

    Returns:
        (n,) int8 index into CATEGORIES.

    Raises:
        ValueError: A name is not a category of this version.
    """
    texts, index = encode_texts(names)
    category = np.array([CATEGORY_INDEX.get(text, -1) for text in [*texts.to_pylist(), None]], np.int8)[index]
    if (category < 0).any():
        raise ValueError("the primitives table holds an unknown category; preprocess again with this version")
    return category


def read_fixed_lists(column: pa.ChunkedArray, width: int) -> np.ndarray:
    """Return a column of fixed-size lists as an array.

    Args:
        column: Column of float32 lists.
        width: Number of values per list.

    Returns:
        (n, width) float32.
    """
    flat = pa.concat_arrays(column.chunks).flatten() if len(column) else pa.array([], pa.float32())
    return flat.to_numpy().reshape(-1, width)


def _read_primitive_fields(primitives: pa.Table) -> dict[str, np.ndarray]:
    """Return the per-primitive arrays of a Scene for all rows of a primitives table."""
    primitives = primitives.combine_chunks()

    def column(name: str) -> np.ndarray:
        return primitives[name].to_numpy()

    def stacked(*names: str) -> np.ndarray:
        return np.stack([column(name) for name in names], axis=1)

    texts, index = encode_texts(primitives["label"])
    return {
        "category": find_category_indices(primitives["category"]),
        "center_m": stacked("x_m", "y_m", "z_m"),
        "rotation": read_fixed_lists(primitives["rotation"], 9).reshape(-1, 3, 3),
        "size_m": stacked("length_m", "width_m", "height_m"),
        "existence": column("existence"),
        "heading_rad": column("heading_rad").astype(np.float32),
        "instance_id": column("instance_id"),
        "label": np.array([*texts.to_pylist(), None], object)[index],
    }


# ------------------------------------------------------------------------------------------------------- shards


@dataclass(frozen=True, order=True)
class Shard:
    """One shard of a dataset directory.

    A shard has one Parquet file per table; all these files have the same number.

    Attributes:
        root: Dataset directory.
        source: Value of the source column.
        split: Value of the split column.
        number: Number of the part, from 0.
    """

    root: str
    source: str
    split: str
    number: int

    def path(self, table: str) -> str:
        """Return the path of the shard's file in a table.

        Args:
            table: Name of the table, such as scenes.

        Returns:
            Path or URI of the Parquet file.
        """
        return storage.join_uri(self.place(table), f"part-{self.number:05d}.parquet")

    def place(self, table: str) -> str:
        """Return the directory of a table's files for this source and split.

        Args:
            table: Name of the table, such as scenes.

        Returns:
            Path or URI of the directory.
        """
        return storage.join_uri(self.root, table, f"source={self.source}", f"split={self.split}")

    def read(self, table: str, columns: list[str] | None = None, encoded: Sequence[str] = ()) -> pa.Table:
        """Read the shard's rows of a table, and validate each column.

        Args:
            table: Name of the table, such as scenes.
            columns: Names of the columns to read (default: all).
            encoded: Names of text columns to return with dictionary encoding, which is faster (default: plain texts).

        Returns:
            The rows.

        Raises:
            ValueError: The file is missing or damaged, or a value is invalid. The message names the file, the row and
                the column.
        """
        schema = {
            "scenes": SCENES,
            "primitives": PRIMITIVES,
            "rasters": RASTERS,
            "edits": EDITS,
            "rejects": REJECTS,
        }.get(table)
        content = storage.read_parquet(self.path(table), columns, schema, encoded)
        with self._naming(table):
            validate_table(table, content)
        return content

    def read_tables(self) -> tuple[pa.Table, pa.Table, pa.Table]:
        """Read the tables scenes, primitives and rasters, and validate that they belong together.

        Returns:
            The three tables. The texts of `primitives` have dictionary encoding.

        Raises:
            ValueError: A file is missing or damaged, or a value is invalid. The message names the file, the row and the
                column.
        """
        tables = self.read("scenes"), self.read("primitives", encoded=TEXTS), self.read("rasters")
        with self._naming("scenes"):
            validate_shard(*tables)
        return tables

    @contextmanager
    def _naming(self, table: str) -> Iterator[None]:
        """Put the name of a table's file in front of an error."""
        try:
            yield
        except LimitError as error:
            raise LimitError(f"{self.path(table)}: {error}") from error
        except ValueError as error:
            raise ValueError(
                f"{self.path(table)}: {error}; restore the shard or run the job that wrote it again"
            ) from error

    def scenes(self, rows: Sequence[int] | None = None) -> list[Scene]:
        """Read Scenes of the shard.

        Args:
            rows: Row numbers of the scenes, in this order (default: all).

        Returns:
            The Scenes.

        Raises:
            ValueError: A file is missing or damaged, or a value is invalid. The message names the file, the row and the
                column.
        """
        return list(parse_scenes(*self.read_tables(), self.source, self.split, rows))

    def write(self, scenes: Sequence[Scene]) -> None:
        """Write the tables scenes, primitives and rasters of the shard.

        Args:
            scenes: All scenes of the shard.
        """
        for table, content in make_scene_tables(scenes).items():
            storage.write_parquet(content, self.path(table))

    def find_fault(self, num_scenes: int | None = None) -> str:
        """Compare the files of the tables scenes, primitives and rasters with each other.

        The function reads the footers of the files and one column of `scenes`; it does not validate the other values.

        Args:
            num_scenes: Expected number of scenes (default: the number in `scenes`).

        Returns:
            Description of a missing file, a damaged file or a wrong number of rows; "" if there is none.
        """
        try:
            counts = storage.read_parquet(self.path("scenes"), ["num_primitives"])["num_primitives"]
            scenes = len(counts) if num_scenes is None else num_scenes
            expected = {"scenes": scenes, "rasters": scenes, "primitives": sum(counts.to_pylist())}
            found = {"scenes": len(counts)} | {
                table: storage.read_num_rows(self.path(table)) for table in ("primitives", "rasters")
            }
        except ValueError as error:
            return str(error)
        for table, rows in expected.items():
            if found[table] != rows:
                return f"{self.path(table)}: {found[table]:,} rows, expected {rows:,}"
        return ""


def find_faults(promised: Mapping[Shard, int]) -> dict[Shard, str]:
    """Find the shards that are missing, damaged or have another number of scenes than promised.

    Args:
        promised: Number of scenes of each shard.

    Returns:
        Description of the fault of each faulty shard (`Shard.find_fault`).
    """
    files = {shard: [shard.path(table) for table in SCENE_TABLES] for shard in promised}
    return storage.find_faults(files, lambda shard: shard.find_fault(promised[shard]))


def require_written(promised: Mapping[Shard, int]) -> None:
    """Check that a job has written the shards that it reports.

    Args:
        promised: Number of scenes of each shard.

    Raises:
        ValueError: A shard is missing, damaged or has another number of scenes.
    """
    storage.raise_faults(find_faults(promised), len(promised))


def find_unwritten(promised: Mapping[Shard, int]) -> list[Shard]:
    """Return the shards that a resumed job must write, in order. A damaged shard is reported as a warning.

    Args:
        promised: Number of scenes of each shard.

    Returns:
        Shards with a fault (`find_faults`).
    """
    faults = find_faults(promised)
    for fault in faults.values():
        if not fault.endswith(storage.MISSING):
            logger.warning("%s; the shard is written again", fault)
    return list(faults)


def find_shards(root: str, table: str = "scenes", source: str | None = None, split: str | None = None) -> list[Shard]:
    """Return the shards of a table, in order.

    Args:
        root: Dataset directory.
        table: Name of the table.
        source: Value of the source column (default: all sources).
        split: Value of the split column (default: all splits).

    Returns:
        The shards; the list is never empty.

    Raises:
        ValueError: The directory holds no matching shard.
    """
    shards = []
    for path in storage.list_files(storage.join_uri(root, table), ".parquet"):
        source_part, split_part, name = f"//{split_options(path)[0]}".rsplit("/", 3)[1:]
        found = (source_part.removeprefix("source="), split_part.removeprefix("split="))
        if (source or found[0], split or found[1]) == found:
            number = name.removeprefix("part-").removesuffix(".parquet")
            if not (source_part.startswith("source=") and split_part.startswith("split=") and number.isdecimal()):
                raise ValueError(
                    f"{path}: expected the name {table}/source=.../split=.../part-<number>.parquet; move other files"
                    " out of the dataset directory"
                )
            shards.append(Shard(str(root), *found, int(number)))
    if not shards:
        place, wanted = (
            storage.join_uri(root, table),
            "/".join(f"{k}={v}" for k, v in (("source", source), ("split", split)) if v),
        )
        there = sorted(
            {"/".join(split_options(path)[0].split("/")[-3:-1]) for path in storage.list_files(place, ".parquet")}
        )
        if there:
            raise ValueError(f"{place} holds no {wanted}; it holds {', '.join(there)}")
        raise ValueError(
            f"{place} holds no scenes; pass a directory that jobs/preprocess_scenes.py or another job wrote"
        )
    return shards


def read_scenes(
    root: str, source: str | None = None, split: str | None = None, limit: int | None = None
) -> Iterator[Scene]:
    """Yield the scenes of a dataset directory, shard by shard.

    Args:
        root: Dataset directory.
        source: Value of the source column (default: all sources).
        split: Value of the split column (default: all splits).
        limit: Maximum number of scenes (default: all).

    Yields:
        Each Scene, in the order of the shards.
    """
    left = limit
    for shard in find_shards(root, "scenes", source, split):
        for scene in shard.scenes():
            if left == 0:
                return
            yield scene
            left = None if left is None else left - 1


def make_rejects_table(rows: Iterable[dict]) -> pa.Table:
    """Make the rejects table.

    Args:
        rows: One dictionary per reject, with the keys of the schema REJECTS.

    Returns:
        Table with the schema REJECTS.
    """
    return pa.Table.from_pylist(list(rows), schema=REJECTS)
