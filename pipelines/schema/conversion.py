"""Convert scenes to the rows of the tables scenes, primitives and rasters, and back."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import pyarrow as pa

from models.geometry.cholesky import compute_cholesky_parameters
from models.scene import CATEGORIES, CATEGORY_INDEX, ELLIPSOID, GROUND_CLASSES, VEGETATION, VEHICLES, Grid, Scene
from pipelines.schema.columns import HEIGHT_STEP_M, PRIMITIVES, RASTERS, REJECTS, SCENES
from pipelines.schema.validation import encode_texts

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
        "attribution": [s.attribution for s in scenes],
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


def make_rejects_table(rows: Iterable[dict]) -> pa.Table:
    """Make the rejects table.

    Args:
        rows: One dictionary per reject, with the keys of the schema REJECTS.

    Returns:
        Table with the schema REJECTS.
    """
    return pa.Table.from_pylist(list(rows), schema=REJECTS)


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
            attribution=scene["attribution"],
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
