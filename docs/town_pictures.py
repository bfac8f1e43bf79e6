"""Draw scenes of both versions of the town from above, and real scenes for a comparison that stays on this machine.

python docs/town_pictures.py                                      writes docs/pictures/town1.png and town2.png
python docs/town_pictures.py --kitti360 DATASET --output DIR      writes DIR/kitti360.png as well

DATASET is the output of `jobs/preprocess_scenes.py kitti360`. Its licence does not allow a copy in this repository, so
--output must lie outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from models.scene import Scene
from pipelines.preprocess.sources.town.generator import TOWN_VERSIONS, generate_town, select_poses
from pipelines.rendering.render import arrange_contact_sheet, encode_png, render_bev
from pipelines.schema.tables import read_scenes

PICTURES = Path(__file__).parent / "pictures"
COLUMNS, SHOWN, SIZE_PX, GAP_PX = 4, 8, 240, 8
SEEDS = range(2_000_000, 2_000_000 + SHOWN)


@dataclass(frozen=True)
class Config:
    kitti360: str = ""
    """Dataset directory of KITTI-360 scenes (default: none)."""
    output: str = ""
    """Directory outside the repository, for the picture of real scenes."""


def select_scenes(version: int) -> list[Scene]:
    """Return one unselected scene of each of several towns."""
    drives = [generate_town(seed, version) for seed in SEEDS]
    return [drive.scene(int(select_poses(len(drive), 3)[k % 3])) for k, drive in enumerate(drives)]


def draw_sheet(scenes: list[Scene]) -> bytes:
    """Return a PNG file that shows scenes from above."""
    pictures = [render_bev(scene, SIZE_PX, 2) for scene in scenes]
    return encode_png(arrange_contact_sheet(pictures, COLUMNS, gap_px=GAP_PX))


def main(config: Config) -> None:
    for version in TOWN_VERSIONS:
        (PICTURES / f"town{version}.png").write_bytes(draw_sheet(select_scenes(version)))
    if config.kitti360:
        folder = Path(config.output).resolve()
        if not config.output or folder.is_relative_to(PICTURES.parent.parent.resolve()):
            raise ValueError(f"--output is {config.output!r}, expected a directory outside the repository")
        real = sorted(read_scenes(config.kitti360, "kitti360"), key=lambda scene: (scene.sequence, scene.frame))
        shown = [real[k] for k in np.linspace(0, len(real) - 1, SHOWN).astype(int)]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "kitti360.png").write_bytes(draw_sheet(shown))


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
