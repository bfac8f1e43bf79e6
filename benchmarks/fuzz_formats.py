"""Formats for benchmarks/fuzz.py: how to make a valid file, damage it, read it, and check an accepted result.

A format reads files with the readers of this project. `check` compares an accepted result with the invariants that
SECURITY.md promises, and with what an independent reader (DuckDB, trimesh, numpy, ElementTree, safetensors) gets from
the same file.
"""

from __future__ import annotations

import base64
import copy
import io
import json
import random
import struct
import xml.etree.ElementTree as ElementTree
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.feather
import safetensors.numpy
import torch
import trimesh
from fuzz_damage import (
    change_bytes,
    change_glb,
    change_npy_header,
    change_npz,
    change_table,
    change_text,
    change_tree,
    dump_json,
    join_glb,
    split_glb,
    write_feather,
    write_parquet,
)

from models.dit import DiT
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.pipeline import PrITTIPipeline
from models.presets import LVAE_PRESETS
from models.scene import CATEGORIES, Grid, Scene
from pipelines.editing.edit import parse_edits
from pipelines.io.gltf_reader import place_parts, read_glb
from pipelines.io.mesh_export import export_glb
from pipelines.io.mesh_import import import_glb
from pipelines.io.opendrive import export_opendrive
from pipelines.io.voxel_import import read_voxels
from pipelines.metrics.adm_npz import iterate_pictures, read_picture_shape, read_reference_moments
from pipelines.preprocess.sources import argoverse2, custom, kitti360
from pipelines.preprocess.sources.drive import Drive
from pipelines.preprocess.sources.opendrive import reader as opendrive
from pipelines.preprocess.sources.osm import reader as osm
from pipelines.preprocess.sources.town.generator import generate_town, write_kitti360
from pipelines.runtime import storage
from pipelines.schema.tables import Shard

Files = dict[str, bytes]  # Content of each file, by its path in a folder.


class Silent(Exception):
    """Raised by `check` if a reader accepted a file but returned something else than the file holds."""


def require(condition: object, message: str) -> None:
    if not condition:
        raise Silent(message)


# ----------------------------------------------------------------------------------------------------- invariants


def check_scene(scene: Scene) -> None:
    """Check the invariants of a scene."""
    n = len(scene)
    for name in ("center_m", "size_m", "rotation", "existence"):
        require(np.isfinite(getattr(scene, name)).all(), f"{name} is not finite")
    require((scene.size_m > 0).all(), "a size is not positive")
    product = np.einsum("nij,nik->njk", scene.rotation.astype(float), scene.rotation.astype(float))
    require(n == 0 or np.abs(product - np.eye(3)).max() < 5e-3, "a rotation is not orthonormal")
    require(((scene.category >= 0) & (scene.category < len(CATEGORIES))).all(), "a category is unknown")
    require(
        np.isfinite(scene.height_m).all() and not scene.height_m[~scene.occupied].any(), "heights do not fit the masks"
    )
    require(np.isfinite([*scene.world_xyz_m, scene.world_yaw_rad]).all(), "the pose is not finite")
    grid = scene.grid
    require(grid.resolution_m > 0 and np.isfinite([grid.front_m, grid.left_m, grid.resolution_m]).all(), "invalid grid")


def check_drive(drive: Drive) -> None:
    """Check the invariants of a drive."""
    for name in ("center_m", "size_m", "rotation", "world_from_imu"):
        require(np.isfinite(getattr(drive, name)).all(), f"{name} is not finite")
    require((drive.size_m > 0).all(), "a size is not positive")
    product = np.einsum("nij,nik->njk", drive.rotation, drive.rotation)
    require(len(product) == 0 or np.abs(product - np.eye(3)).max() < 5e-3, "a rotation is not orthonormal")


def require_equal(scene: Scene, wanted: Scene) -> None:
    """Require that two scenes are equal in all fields."""
    for field in fields(Scene):
        one, other = getattr(scene, field.name), getattr(wanted, field.name)
        if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
            same = np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
        else:
            same = one is other or one == other
        require(same, f"a changed byte in a table changed {field.name} of {wanted.scene_id}")


# ------------------------------------------------------------------------------------------------------- formats

BYTES = "#bytes"  # Marks files of which bytes were changed, instead of values. Nothing is written for it.


class Format(ABC):
    """One file format: valid inputs, damage, the reader under test, and the check of an accepted result.

    `check` receives the folder, the result of `read`, and the damaged files. It raises Silent.
    """

    name: str
    bases: list[Files]

    @abstractmethod
    def damage(self, base: Files, rng: random.Random) -> Files:
        """Return the files with one kind of damage."""

    @abstractmethod
    def read(self, folder: Path) -> Any:
        """Read the files with the reader under test."""

    @abstractmethod
    def check(self, folder: Path, result: Any, files: Files) -> None:
        """Raise Silent if the result differs from what the files hold."""

    def read_bases(self, folder: Path) -> bool:
        """Read the undamaged files, to make sure that the reader accepts them."""
        for number, files in enumerate(self.bases):
            for name, content in files.items():
                path = folder / str(number) / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
            self.check(folder / str(number), self.read(folder / str(number)), files)
        return True

    def change_one_file(
        self, base: Files, rng: random.Random, change: Callable[[bytes, random.Random], bytes]
    ) -> Files:
        """Apply a change to one file."""
        name = rng.choice(sorted(base))
        return base | {name: change(base[name], rng)}


def make_town_drive() -> Drive:
    return generate_town(3)


def make_scenes(drive: Drive) -> list[Scene]:
    grid = Grid(24.0, 8.0, 0.25, 64, 64)
    return [drive.scene(k, "test").crop(grid) for k in (0, 10, 20)]


class Tables(Format):
    """The tables of a shard."""

    name = "tables"

    def __init__(self, drive: Drive, folder: Path) -> None:
        scenes = make_scenes(drive)
        shard = Shard(str(folder), "town", "test", 0)
        shard.write(scenes)
        self.tables = [shard.read(name) for name in ("scenes", "primitives", "rasters")]
        self.paths = [str(Path(shard.path(name)).relative_to(folder)) for name in ("scenes", "primitives", "rasters")]
        self.bases = [{path: (folder / path).read_bytes() for path in self.paths}]
        self.scenes = shard.scenes()

    def damage(self, base: Files, rng: random.Random) -> Files:
        if rng.random() < 0.5:
            return self.change_one_file(base, rng, change_bytes) | {BYTES: b""}
        k = rng.randrange(3)
        table = self.tables[k]
        for _ in range(rng.choice([1, 1, 2])):
            table = change_table(table, rng)
        return base | {self.paths[k]: write_parquet(table, rng)}

    def read(self, folder: Path) -> list[Scene]:
        return Shard(str(folder), "town", "test", 0).scenes()

    def check(self, folder: Path, result: list[Scene], files: Files) -> None:
        if BYTES in files:  # The pages have checksums, so an accepted file must hold the same scenes.
            require(len(result) == len(self.scenes), "another number of scenes")
            for scene, wanted in zip(result, self.scenes, strict=True):
                require_equal(scene, wanted)
            return
        with duckdb.connect() as connection:
            paths = [str(folder / path) for path in self.paths]
            scenes = connection.execute(f"select scene_id, num_primitives from '{paths[0]}'").fetchall()
            require(scenes == [(scene.scene_id, len(scene)) for scene in result], "other scenes than DuckDB reads")
            columns = "category, x_m, y_m, z_m, length_m, width_m, height_m, existence"
            for scene in result:
                check_scene(scene)
                rows = connection.execute(
                    f"select {columns} from '{paths[1]}' where scene_id = ?", [scene.scene_id]
                ).fetchnumpy()
                require([CATEGORIES[k] for k in scene.category] == list(rows["category"]), "other categories")
                values = np.concatenate([scene.center_m, scene.size_m, scene.existence[:, None]], axis=1)
                wanted = np.stack([rows[name] for name in columns.split(", ")[1:]], axis=1)
                require(np.array_equal(values, wanted), "other numbers than DuckDB reads")
                mask, rows_, cols = connection.execute(
                    f"select occupied, rows, cols from '{paths[2]}' where scene_id = ?", [scene.scene_id]
                ).fetchall()[0]
                bits = np.unpackbits(np.frombuffer(mask, np.uint8))[: scene.occupied.size]
                require(scene.occupied.shape[1:] == (rows_, cols), "another grid than DuckDB reads")
                require(np.array_equal(scene.occupied.ravel(), bits), "another mask than DuckDB reads")


class OwnGlb(Format):
    """GLB files that this project wrote."""

    name = "glb-own"

    def __init__(self, drive: Drive, folder: Path) -> None:
        self.bases = [{"a.glb": export_glb(make_scenes(drive)[0])}]

    def damage(self, base: Files, rng: random.Random) -> Files:
        return self.change_one_file(base, rng, change_glb)

    def read(self, folder: Path) -> Scene:
        return import_glb(str(folder / "a.glb"))

    def check(self, folder: Path, result: Scene, files: Files) -> None:
        check_scene(result)
        tree, _ = split_glb(files["a.glb"])
        stored = [node for node in list_scene_nodes(tree) if "category" in (node.get("extras") or {})]
        require(len(stored) == len(result), "another number of primitives than nodes with a category")


def list_scene_nodes(tree: dict) -> list[dict]:
    """Return the nodes of the default scene of a glTF file."""
    todo, found = list(tree["scenes"][tree.get("scene", 0)].get("nodes", [])), []
    while todo:
        found.append(tree["nodes"][todo.pop()])
        todo += found[-1].get("children", [])
    return found


class ForeignGlb(Format):
    """GLB files of another program, with buffers of every kind."""

    name = "glb-foreign"

    def __init__(self, drive: Drive, folder: Path) -> None:
        rng = np.random.default_rng(0)
        scene = trimesh.Scene()
        for k in range(4):
            box = trimesh.creation.box(extents=(4.0, 2.0, 1.5))
            color = np.array([[0, 0, 142], [70, 70, 70], [153, 153, 153], [107, 142, 35]][k])
            box.visual.vertex_colors = np.append(color, 255).astype(np.uint8)
            place = trimesh.transformations.rotation_matrix(rng.uniform(0, 6), (0, 0, 1))
            place[:3, 3] = rng.uniform(5, 20), rng.uniform(-8, 8), 0.75
            scene.add_geometry(box, transform=place)
        plain = scene.export(file_type="glb")
        tree, binary = split_glb(plain)
        inside = copy.deepcopy(tree)
        inside["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
        self.bases = [{"a.glb": plain}, {"a.glb": join_glb(json.dumps(inside).encode(), b"")}]

    def damage(self, base: Files, rng: random.Random) -> Files:
        return self.change_one_file(base, rng, change_glb)

    def read(self, folder: Path) -> Any:
        content = storage.read_bytes(str(folder / "a.glb"), "glb_bytes")
        glb = read_glb(content)
        return glb, import_glb(str(folder / "a.glb"))

    def check(self, folder: Path, result: Any, files: Files) -> None:
        glb, scene = result
        check_scene(scene)
        vertices = place_parts(glb.parts)
        for part, placed in zip(glb.parts, vertices, strict=True):
            require(np.isfinite(placed).all(), "a vertex is not finite")
            require(((part.local.color >= 0) & (part.local.color <= 1)).all(), "a colour lies outside [0, 1]")
        try:
            loaded: Any = trimesh.load(io.BytesIO(files["a.glb"]), file_type="glb", process=False)
            bounds, count = (
                loaded.bounds,
                sum(
                    len(loaded.geometry[name].vertices)
                    for _, name in map(loaded.graph.get, loaded.graph.nodes_geometry)
                ),
            )
        except Exception:
            return  # trimesh cannot read the file.
        if vertices and bounds is not None:
            own = np.concatenate(vertices)
            require(len(own) == count, f"{len(own)} vertices, but trimesh reads {count}")
            require(
                np.allclose([own.min(axis=0), own.max(axis=0)], bounds, rtol=1e-4, atol=1e-3),
                "other bounds than trimesh reads",
            )


class Npz(Format):
    """Directories and contents of .npz files."""

    def damage(self, base: Files, rng: random.Random) -> Files:
        return self.change_one_file(base, rng, change_npz)

    def load(self, content: bytes, name: str) -> np.ndarray | None:
        """Return an array as numpy reads it, or None."""
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
                return arrays[name] if name in arrays else arrays[arrays.files[0]]
        except Exception:
            return None


class Voxels(Npz):
    """Voxel grids of other methods."""

    name = "voxels"

    def __init__(self, drive: Drive, folder: Path) -> None:
        rng = np.random.default_rng(0)
        grid = rng.integers(0, 17, (32, 32, 4)).astype(np.uint8)
        self.bases = []
        for save in (np.savez, np.savez_compressed):
            for kind in (np.uint8, np.int64):
                save(file := io.BytesIO(), voxels=grid.astype(kind))
                self.bases.append({"a.npz": file.getvalue()})

    def read(self, folder: Path) -> np.ndarray:
        return read_voxels(str(folder / "a.npz"))

    def check(self, folder: Path, result: np.ndarray, files: Files) -> None:
        require(result.shape == (256, 256, 32) and result.dtype == np.uint8 and result.max() <= 17, "invalid voxels")
        wanted = self.load(files["a.npz"], "voxels")
        require(wanted is not None, "numpy refuses the file")
        factors = np.array(result.shape) // np.array(wanted.shape)
        require(
            np.array_equal(result[tuple(slice(None, None, f) for f in factors)], wanted),
            "other voxels than numpy reads",
        )


class Pictures(Npz):
    """Pictures in ADM's format."""

    name = "adm"

    def __init__(self, drive: Drive, folder: Path) -> None:
        rng = np.random.default_rng(0)
        pictures = rng.integers(0, 256, (5, 8, 8, 3)).astype(np.uint8)
        np.savez(plain := io.BytesIO(), arr_0=pictures)
        np.savez_compressed(packed := io.BytesIO(), arr_0=pictures)
        self.bases = [{"a.npz": plain.getvalue()}, {"a.npz": packed.getvalue()}]

    def read(self, folder: Path) -> Any:
        path = str(folder / "a.npz")
        read_reference_moments(path)
        return read_picture_shape(path), np.concatenate(list(iterate_pictures(path, 2)))

    def check(self, folder: Path, result: Any, files: Files) -> None:
        shape, pictures = result
        require(pictures.shape == shape and pictures.dtype == np.uint8, "another shape than stated")
        wanted = self.load(files["a.npz"], "arr_0")
        require(wanted is not None and np.array_equal(wanted, pictures), "other pictures than numpy reads")


class Kitti360(Format):
    """XML and poses of KITTI-360."""

    name = "kitti360"
    sequence = "2013_05_28_drive_0003_sync"

    def __init__(self, drive: Drive, folder: Path) -> None:
        write_kitti360(drive, folder)
        path = next((folder / "data_3d_bboxes").rglob("*.xml"))
        self.sequence = path.stem
        tree = ElementTree.parse(path)
        root = tree.getroot()
        for number, one in enumerate(list(root)):
            if number % max(1, len(root) // 12):
                root.remove(one)
        poses = next((folder / "data_poses").rglob("poses.txt"))
        lines = poses.read_text().splitlines()[:20]
        self.bases = [
            {
                str(path.relative_to(folder)): ElementTree.tostring(root),
                str(poses.relative_to(folder)): ("\n".join(lines) + "\n").encode(),
            }
        ]

    def damage(self, base: Files, rng: random.Random) -> Files:
        return self.change_one_file(base, rng, change_text)

    def read(self, folder: Path) -> Any:
        return kitti360.read_drive(folder, kitti360.list_sequences(folder)[0])

    def check(self, folder: Path, result: Any, files: Files) -> None:
        drive, _ = result
        check_drive(drive)
        path = next(name for name in files if name.endswith(".xml"))
        require(b"<!ENTITY" not in files[path], "an entity was accepted")
        try:
            objects = len(ElementTree.fromstring(files[path]))
        except (ElementTree.ParseError, ValueError, LookupError):
            raise Silent("ElementTree refuses the XML") from None
        require(len(drive.center_m) <= objects, "more objects than in the XML")


class Argoverse2(Format):
    """Feather, JSON and height files of Argoverse 2."""

    name = "argoverse2"
    log = "00000000-0000-3000-8000-000000000000"

    def __init__(self, drive: Drive, folder: Path) -> None:
        sweeps = 315_966_000_000_000_000 + np.arange(3) * 100_000_000
        ones, n = np.ones(6), 6
        columns: dict[str, Any] = {
            "timestamp_ns": sweeps.repeat(2),
            "track_uuid": [f"track-{k % 2}" for k in range(n)],
            "category": ["REGULAR_VEHICLE", "CONSTRUCTION_CONE"] * 3,
            **dict.fromkeys(("length_m", "width_m", "height_m", "qw"), ones),
            **dict.fromkeys(("qx", "qy", "qz"), 0 * ones),
            **{name: np.arange(n) + 10.0 for name in ("tx_m", "ty_m", "tz_m")},
            "num_interior_pts": np.zeros(n, np.int64),
        }
        poses = {"timestamp_ns": sweeps, "qw": np.ones(3), **dict.fromkeys(("qx", "qy", "qz"), np.zeros(3))}
        poses |= {name: np.arange(3) * 1.0 for name in ("tx_m", "ty_m", "tz_m")}
        corners = [{"x": x, "y": y, "z": 0.0} for x, y in ((-40.0, -40.0), (40.0, -40.0), (40.0, 40.0), (-40.0, 40.0))]
        edges = [[{"x": x, "y": y, "z": 0.0} for y in (0.0, 10.0)] for x in (10.0, 13.0)]
        self.tree = {
            "drivable_areas": {"1": {"id": 1, "area_boundary": corners}},
            "lane_segments": {},
            "pedestrian_crossings": {"2": {"id": 2, "edge1": edges[0], "edge2": edges[1]}},
        }
        self.sim2 = {"R": [1.0, 0.0, 0.0, 1.0], "t": [50.0, 50.0], "s": 10 / 3}
        np.save(heights := io.BytesIO(), np.zeros((333, 333), np.float16))
        self.tables = {"annotations.feather": pa.table(columns), "city_SE3_egovehicle.feather": pa.table(poses)}
        root, self.map = f"train/{self.log}/", f"map/log_map_archive_{self.log}____PIT_city_1.json"
        self.root = root
        self.bases = [
            {root + name: write_feather(table) for name, table in self.tables.items()}
            | {
                root + self.map: json.dumps(self.tree).encode(),
                f"{root}map/{self.log}___img_Sim2_city.json": json.dumps(self.sim2).encode(),
                f"{root}map/{self.log}_ground_height_surface____PIT.npy": heights.getvalue(),
            }
        ]

    def damage(self, base: Files, rng: random.Random) -> Files:
        name = rng.choice(sorted(base))
        short = name.removeprefix(self.root)
        if rng.random() < 0.3:
            return base | {name: change_bytes(base[name], rng)}
        if short in self.tables:
            return base | {name: write_feather(change_table(self.tables[short], rng))}
        if short.endswith(".npy"):
            return base | {name: change_npy_header(base[name], rng)}
        return base | {name: dump_json(change_tree(self.tree if short == self.map else self.sim2, rng), rng)}

    def read(self, folder: Path) -> Drive:
        return argoverse2.read_drive(folder, "train", self.log)

    def check(self, folder: Path, result: Drive, files: Files) -> None:
        check_drive(result)
        table = pyarrow.feather.read_table(folder / self.root / "annotations.feather", memory_map=False)
        sizes = np.stack([table[f"{name}_m"].to_numpy() for name in ("length", "width", "height")], axis=1)
        stored = {tuple(sorted(size)) for size in sizes.round(4).tolist()}
        require(len(result.center_m) <= len(table), "more boxes than in the table")
        require({tuple(sorted(size)) for size in result.size_m.round(4).tolist()} <= stored, "other sizes than stored")


class Custom(Format):
    """Drives in the project's own format, as JSON and as Parquet."""

    name = "custom"

    def __init__(self, drive: Drive, folder: Path) -> None:
        def place(x: float, y: float, z: float) -> dict:
            return {"x_m": x, "y_m": y, "z_m": z}

        size = {"length_m": 4.0, "width_m": 2.0, "height_m": 1.5}
        outline = [[-50.0, -4.0, 0.0], [150.0, -4.0, 0.0], [150.0, 4.0, 0.0], [-50.0, 4.0, 0.0]]
        self.trees: dict[str, list] = {
            "boxes": [
                {"category": name, "yaw_rad": 0.1 * k, "instance_id": k} | place(8.0 + k, -5.0 + k, 0.5) | size
                for k, name in enumerate(CATEGORIES)
            ],
            "polygons": [
                {"class": "road", "outline": outline},
                {"class": "sidewalk", "outline": [[x, y + 8, z] for x, y, z in outline]},
            ],
            "poses": [{"frame": 10 * k, "yaw_rad": 0.0} | place(2.0 * k, 0.0, 0.0) for k in range(3)],
        }
        self.tables = {name: pa.Table.from_pylist(rows) for name, rows in self.trees.items()}
        rng = random.Random(0)
        self.bases = [
            {f"street/{name}.json": json.dumps(rows).encode() for name, rows in self.trees.items()},
            {f"street/{name}.parquet": write_parquet(table, rng) for name, table in self.tables.items()},
        ]

    def damage(self, base: Files, rng: random.Random) -> Files:
        path = rng.choice(sorted(base))
        name = Path(path).stem
        if rng.random() < 0.3:
            return base | {path: change_bytes(base[path], rng)}
        if path.endswith(".json"):
            return base | {path: dump_json(change_tree(self.trees[name], rng, rng.choice([1, 1, 2])), rng)}
        return base | {path: write_parquet(change_table(self.tables[name], rng), rng)}

    def read(self, folder: Path) -> Drive:
        return custom.read_drive(folder, "street")

    def check(self, folder: Path, result: Drive, files: Files) -> None:
        check_drive(result)
        path = next(name for name in files if "boxes" in name)
        rows = (
            json.loads(files[path])
            if path.endswith(".json")
            else duckdb.sql(f"select category from '{folder / path}'").fetchall()
        )
        require(len(result.center_m) == len(rows), "another number of boxes than in the table")


def check_map(drive: Drive, folder: Path, name: str) -> None:
    """Check a drive that was read from a map, its first scene, and that ElementTree reads the file without entities."""
    check_drive(drive)
    content = (folder / name).read_bytes()
    require(b"<!ENTITY" not in content, "an entity was accepted")
    try:
        ElementTree.fromstring(content)
    except (ElementTree.ParseError, ValueError, LookupError):
        raise Silent("ElementTree refuses the XML") from None
    if len(drive):
        try:
            scene = drive.scene(0)
        except ValueError:  # Such a scene goes to the table rejects.
            return
        require(np.isfinite(scene.height_m).all() and np.isfinite(scene.center_m).all(), "a scene is not finite")


class OpenStreetMap(Format):
    """XML of OpenStreetMap: crossing streets, a house, a lamp, a tree, a signal, a hedge and a meadow."""

    name = "osm"

    def __init__(self, drive: Drive, folder: Path) -> None:
        places = {
            **{1: (0, -9), 2: (0, 0), 3: (0, 9), 4: (-9, 0), 5: (9, 0)},
            **{6: (1, 1), 7: (3, 1), 8: (3, 3), 9: (1, 3), 10: (2, -1), 11: (-1, 2), 12: (5, 1), 13: (7, 1)},
        }
        tags: dict[int, dict[str, str]] = {
            2: {"highway": "traffic_signals"},
            10: {"highway": "street_lamp", "height": "6"},
            11: {"natural": "tree", "height": "9 m", "diameter_crown": "5"},
        }
        ways: list[tuple[list[int], dict[str, str]]] = [
            ([1, 2, 3], {"highway": "residential", "width": "6", "sidewalk": "both", "parking:left": "lane"}),
            ([4, 2, 5], {"highway": "primary", "lanes": "4", "oneway": "yes"}),
            ([6, 7, 8, 9, 6], {"building": "yes", "building:levels": "3"}),
            ([12, 13], {"barrier": "hedge", "height": "2"}),
            ([4, 1, 5, 4], {"landuse": "meadow"}),
        ]
        root = ElementTree.Element("osm", version="0.6")
        for number, (x, y) in places.items():
            place = {"lat": f"{50 + y * 1e-4:.6f}", "lon": f"{10 + x * 1.5e-4:.6f}"}
            node = ElementTree.SubElement(root, "node", {"id": str(number), "version": "1", **place})
            self.add_tags(node, tags.get(number, {}))
        for number, (nodes, of_way) in enumerate(ways):
            way = ElementTree.SubElement(root, "way", id=str(100 + number), version="1")
            for node in nodes:
                ElementTree.SubElement(way, "nd", ref=str(node))
            self.add_tags(way, of_way)
        self.bases = [{"map.osm": ElementTree.tostring(root)}]

    @staticmethod
    def add_tags(element: ElementTree.Element, tags: dict[str, str]) -> None:
        for key, value in tags.items():
            ElementTree.SubElement(element, "tag", k=key, v=value)

    def damage(self, base: Files, rng: random.Random) -> Files:
        return self.change_one_file(base, rng, change_text)

    def read(self, folder: Path) -> Any:
        return osm.read_drive(str(folder / "map.osm"), osm.OsmOptions(furnish=True))

    def check(self, folder: Path, result: Any, files: Files) -> None:
        drive, report = result
        check_map(drive, folder, "map.osm")
        nodes = list(ElementTree.fromstring(files["map.osm"]).iter("node"))
        require(report["objects"].get("tree", 0) <= len(nodes), "more trees than nodes")


class OpenDrive(Format):
    """XML of OpenDRIVE: the export of a scene of the town with lanes and junctions, and objects."""

    name = "opendrive"

    def __init__(self, drive: Drive, folder: Path) -> None:
        root = ElementTree.fromstring(export_opendrive(drive.scene(0)))
        roads = root.findall("road")
        for road in roads[4:]:
            root.remove(road)
        objects = ElementTree.SubElement(roads[0], "objects")
        about = {"s": "2", "t": "6", "zOffset": "0", "hdg": "0.3", "height": "5"}
        for number, kind in enumerate(("tree", "pole", "obstacle", "building")):
            made = ElementTree.SubElement(objects, "object", {"id": str(number), "type": kind, "name": kind} | about)
        outline = ElementTree.SubElement(made, "outline")
        for u, v in ((-4, -3), (4, -3), (4, 3), (-4, 3)):
            ElementTree.SubElement(outline, "cornerLocal", u=str(u), v=str(v), z="0", height="5")
        signals = ElementTree.SubElement(roads[0], "signals")
        ElementTree.SubElement(signals, "signal", {"id": "9", "dynamic": "yes"} | about | {"zOffset": "3"})
        self.bases = [{"map.xodr": ElementTree.tostring(root)}]

    def damage(self, base: Files, rng: random.Random) -> Files:
        return self.change_one_file(base, rng, change_text)

    def read(self, folder: Path) -> Any:
        return opendrive.read_drive(str(folder / "map.xodr"), opendrive.OpenDriveOptions())

    def check(self, folder: Path, result: Any, files: Files) -> None:
        drive, report = result
        check_map(drive, folder, "map.xodr")
        roads = list(ElementTree.fromstring(files["map.xodr"]).iter("road"))
        require(report["roads"] <= len(roads), "more roads than in the file")


class Edits(Format):
    """Lists of edits, in JSON."""

    name = "edits"

    def __init__(self, drive: Drive, folder: Path) -> None:
        select = {"primitives": [0, 1], "category": ["pole"], "polygon_m": [0, -10, 40, -10, 40, 10]}
        self.trees = [
            [{"edit": "translate", "select": select, "by_m": [1, 2, 0]}, {"edit": "remove", "select": select}],
            [
                {"edit": "rotate", "select": select, "by_deg": 15},
                {"edit": "duplicate", "select": select, "by_m": [0, 1, 0]},
            ],
        ]
        self.bases = [{"edits.json": json.dumps(tree).encode()} for tree in self.trees]

    def damage(self, base: Files, rng: random.Random) -> Files:
        if rng.random() < 0.3:
            return self.change_one_file(base, rng, change_bytes)
        return {"edits.json": dump_json(change_tree(json.loads(base["edits.json"]), rng, rng.choice([1, 2])), rng)}

    def read(self, folder: Path) -> Any:
        edits = parse_edits(storage.read_json(str(folder / "edits.json")))
        for edit in edits:
            edit.check()
        return edits

    def check(self, folder: Path, result: Any, files: Files) -> None:
        require(len(result) == len(json.loads(files["edits.json"])), "another number of edits than in the file")


class Models(Format):
    """Pipeline directories: config.json, model_index.json and safetensors."""

    name = "models"

    def __init__(self, drive: Drive, folder: Path) -> None:
        torch.manual_seed(0)
        spec = LayoutSpec(slots=(6,) * len(CATEGORIES)).with_resolution(32)
        lvae = LayoutVAE(layout=spec.to_dict(), **LVAE_PRESETS["smoke"].architecture())
        channels, size, _ = lvae.latent_shape
        PrITTIPipeline(
            lvae, DiT(channels=channels, size=size, width=32, depth=1, heads=2, layout=spec.to_dict())
        ).save_pretrained(folder)
        self.bases = [
            {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
        ]

    def damage(self, base: Files, rng: random.Random) -> Files:
        name = rng.choice(sorted(base))
        content = base[name]
        if rng.random() < 0.05:
            return {path: data for path, data in base.items() if path != name}
        if rng.random() < 0.3:
            return base | {name: change_bytes(content, rng)}
        if name.endswith(".json"):
            return base | {name: dump_json(change_tree(json.loads(content), rng, rng.choice([1, 1, 2])), rng)}
        size = struct.unpack_from("<Q", content)[0]
        header, data = json.loads(content[8 : 8 + size]), bytearray(content[8 + size :])
        if rng.random() < 0.3:
            at = 4 * rng.randrange(len(data) // 4)
            data[at : at + 4] = struct.pack("<f", rng.choice([float("nan"), float("inf"), 1e30, 0.5]))
        else:
            header = change_tree(header, rng, rng.choice([1, 1, 2]))
        text = dump_json(header, rng)
        return base | {name: struct.pack("<Q", len(text)) + text + bytes(data)}

    def read(self, folder: Path) -> PrITTIPipeline:
        return PrITTIPipeline.from_pretrained(folder)

    def check(self, folder: Path, result: PrITTIPipeline, files: Files) -> None:
        for name, model in (("lvae", result.lvae), ("dit", result.dit)):
            stored = safetensors.numpy.load(files[f"{name}/diffusion_pytorch_model.safetensors"])
            state = model.state_dict()
            require(set(stored) == set(state), "other tensors than in the file")
            for key, values in state.items():
                require(bool(values.isfinite().all()), f"{key} is not finite")
                require(np.array_equal(values.numpy(), stored[key]), f"{key} differs from the file")


FORMATS: list[Callable[[Drive, Path], Format]] = [
    Tables, OwnGlb, ForeignGlb, Voxels, Pictures, Kitti360, Argoverse2, Custom, OpenStreetMap, OpenDrive, Edits,
    Models,
]  # fmt: skip
