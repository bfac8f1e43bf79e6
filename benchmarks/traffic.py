"""Write scenes of 192 m for jobs/simulate_traffic.py: crops of procedural towns, and squares of maps.

    python benchmarks/traffic.py --output DIR --maps EXTRACT.osm.gz ...
    jobs/simulate_traffic.py --input DIR/town
    jobs/simulate_traffic.py --input DIR/osm --reference DIR/town

Data of OpenStreetMap: (c) OpenStreetMap contributors, ODbL.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from models.scene import Grid
from pipelines.preprocess.sources.maps import make_world_from_imu
from pipelines.preprocess.sources.osm.reader import OsmOptions, read_drive
from pipelines.preprocess.sources.town.version2.town import make_large_crops
from pipelines.preprocess.sources.town.world import IMU_HEIGHT_M
from pipelines.schema.tables import Shard

FIRST_TOWN = 3_000_000
NORTH_RAD = np.pi / 2


@dataclass(frozen=True)
class Config:
    output: Path
    """Directory to write."""
    maps: tuple[str, ...] = ()
    """Extracts of OpenStreetMap (default: none)."""
    num_scenes: int = 24
    """Number of crops of towns, and of squares of all maps."""
    size_m: float = 192.0
    """Side of a scene in metres."""


def main(config: Config) -> None:
    side = round(config.size_m / 0.25)
    grid = Grid(config.size_m / 2, config.size_m / 2, 0.25, side, side)
    towns = [
        replace(next(iter(make_large_crops(FIRST_TOWN + k, 1, grid))), split="test") for k in range(config.num_scenes)
    ]
    Shard(str(config.output / "town"), "town", "test", 0).write(towns)
    places = []
    for path in config.maps:
        drive, _ = read_drive(path, OsmOptions(free_pose_share=0.0, unmapped_ground="terrain"))
        share = -(-config.num_scenes // len(config.maps))
        for pose in np.linspace(0, len(drive) - 1, share + 2).astype(int)[1:-1]:
            middle_m = drive.world_from_imu[pose, :, 3] - [0.0, 0.0, IMU_HEIGHT_M]
            here = make_world_from_imu(middle_m[None], np.array([NORTH_RAD]))
            one = replace(drive, frame=np.array([pose]), world_from_imu=here, free_pose=np.ones(1, bool))
            places.append(one.scene(0, "test", grid))
    if places:
        Shard(str(config.output / "osm"), "osm", "test", 0).write(places[: config.num_scenes])


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
