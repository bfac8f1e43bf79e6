"""Read a square of a real map as one scene, such as a block of a city from an extract of OpenStreetMap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from models.scene import Grid, Scene
from pipelines.preprocess.sources.maps import make_world_from_imu
from pipelines.preprocess.sources.opendrive import file
from pipelines.preprocess.sources.opendrive import reader as opendrive
from pipelines.preprocess.sources.osm import reader as osm
from pipelines.preprocess.sources.osm.extract import Region
from pipelines.preprocess.sources.town.world import IMU_HEIGHT_M


@dataclass(frozen=True)
class PlaceOptions:
    """Place on a map.

    Attributes:
        origin: Middle of the place: latitude and longitude (degrees) for OpenStreetMap, x and y in the inertial frame
            (m) for OpenDRIVE. None: the pose on the streets that is nearest to the mean of all poses.
        size_m: Side of the square (m).
        heading_deg: Compass direction of the x axis of the scene, clockwise from north.
        drive_on_left: Whether vehicles drive on the left (OpenStreetMap).
    """

    origin: tuple[float, float] | None = None
    size_m: float = 192.0
    heading_deg: float = 0.0
    drive_on_left: bool = False


def read_place(path: str, options: PlaceOptions, resolution_m: float, number: int = 0) -> Scene:
    """Read a square of a map. Land that the map leaves open becomes terrain.

    Args:
        path: Extract of OpenStreetMap, or an OpenDRIVE file.
        options: Place.
        resolution_m: Size of a pixel (m).
        number: Number of the place, which becomes the frame of the scene.

    Returns:
        The scene, whose origin is the middle of the place.

    Raises:
        ValueError: The file cannot be read, or no street lies in the place.
    """
    side = round(options.size_m / resolution_m)
    half_m = side * resolution_m / 2
    grid = Grid(half_m, half_m, resolution_m, side, side)
    if path.endswith(file.SUFFIXES):
        drive, _ = opendrive.read_drive(path, opendrive.OpenDriveOptions(unmapped_ground="terrain"))
    else:
        region = Region(origin_deg=options.origin, radius_m=half_m * 2**0.5)
        settings = osm.OsmOptions(region, drive_on_left=options.drive_on_left, unmapped_ground="terrain")
        drive, _ = osm.read_drive(path, settings)
    poses_m = drive.world_from_imu[:, :, 3]
    middle_m = poses_m[:, :2].mean(axis=0) if len(poses_m) else np.zeros(2)
    if options.origin is not None:  # The frame of an extract has its origin at the middle of the region.
        middle_m = np.array(options.origin if path.endswith(file.SUFFIXES) else (0.0, 0.0))
    distance_m = np.abs(poses_m[:, :2] - middle_m).max(axis=1)
    if not len(distance_m) or distance_m.min() > half_m:
        found = f"the nearest is {distance_m.min():.0f} m away" if len(distance_m) else "the file has none nearby"
        raise ValueError(
            f"{path}: no street lies within {half_m:g} m of the middle of the place; {found}; choose another --origin"
            " or a larger --size-m"
        )
    nearest = poses_m[distance_m.argmin()]
    ground_m = (nearest if options.origin is None else np.append(middle_m, nearest[2])) - [0.0, 0.0, IMU_HEIGHT_M]
    here = make_world_from_imu(ground_m[None], np.array([np.pi / 2 - np.deg2rad(options.heading_deg)]))
    drive = replace(drive, frame=np.array([number]), world_from_imu=here, free_pose=np.ones(1, bool))
    return drive.scene(0, "unused", grid)
