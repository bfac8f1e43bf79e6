"""Functions that the readers of maps share: input files, poses, ground and licence notices."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from models.scene import KITTI_GROUND_CLASSES, Grid, Scene
from pipelines.preprocess.sources.drive import Drive, LayeredGround
from pipelines.preprocess.sources.input_paths import InputPath, make_input_path
from pipelines.preprocess.sources.town.world import IMU_HEIGHT_M

SQUARE_M = 256.0  # Side of the squares that order the poses.


@dataclass(frozen=True, eq=False)
class MapDrive(Drive):
    """Drive whose scenes state a licence notice.

    Attributes:
        attribution: Notice, or None.
    """

    attribution: str | None = None

    def scene(self, index: int, split: str = "unused", grid: Grid | None = None) -> Scene:
        """Crop the Scene ahead of a pose; see `Drive.scene`."""
        return replace(super().scene(index, split, grid), attribution=self.attribution)


def list_map_files(inputs: Iterable[str], suffixes: tuple[str, ...], remedy: str) -> list[str]:
    """Return the paths of map files.

    Args:
        inputs: Files, or directories that contain files with one of the suffixes.
        suffixes: Suffixes of map files.
        remedy: End of the error messages.

    Returns:
        Paths of the files.

    Raises:
        ValueError: A path does not exist, a directory has no such file, or two files have the same name.
    """
    found: dict[str, str] = {}
    for text in inputs:
        path = make_input_path(text)
        paths: list[InputPath] = [path]
        if path.is_dir():
            paths = sorted(child for child in path.glob("*") if child.name.endswith(suffixes))
        elif not path.is_file():
            raise ValueError(f"--input {path}: no such file or directory; {remedy}")
        if not paths:
            raise ValueError(f"--input {path} contains no file that ends with {', '.join(suffixes)}; {remedy}")
        for file in paths:
            name = make_map_name(file, suffixes)
            if name in found:
                raise ValueError(f"{file} and {found[name]} would both be named {name}; rename one of the files")
            found[name] = str(file)
    return list(found.values())


def make_map_name(path: InputPath, suffixes: tuple[str, ...]) -> str:
    """Return the name of a file without suffixes. Characters that scene ids cannot contain become underscores."""
    name = path.name
    for suffix in sorted(suffixes, key=len, reverse=True):
        name = name.removesuffix(suffix)
    return re.sub(r"[^A-Za-z0-9._-]", "_", name) or "map"


def fill_ground(ground: LayeredGround, name: str | None) -> LayeredGround:
    """Return the ground with a class for places that the map leaves open.

    Args:
        ground: Ground with the classes KITTI_GROUND_CLASSES.
        name: Name of the class; None: no class.

    Returns:
        The ground.
    """
    return ground if name is None else replace(ground, fill_class=KITTI_GROUND_CLASSES.index(name))


def order_by_squares(xy_m: np.ndarray) -> np.ndarray:
    """Return an order (p,) that groups points by square; the squares follow a serpentine order."""
    square = np.floor(xy_m / SQUARE_M).astype(np.int64)
    column = np.where(square[:, 1] % 2 == 0, square[:, 0], -square[:, 0])
    return np.lexsort([np.arange(len(xy_m)), column, square[:, 1]])


def make_world_from_imu(road_m: np.ndarray, yaw_rad: np.ndarray) -> np.ndarray:
    """Return pose matrices (p, 3, 4) with the axes x forward, y right and z down, IMU_HEIGHT_M above points (p, 3)."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    zero, one = np.zeros_like(cos), np.ones_like(cos)
    axes = [np.stack(axis, axis=1) for axis in ((cos, sin, zero), (sin, -cos, zero), (zero, zero, -one))]
    return np.stack([*axes, road_m + [0.0, 0.0, IMU_HEIGHT_M]], axis=2)
