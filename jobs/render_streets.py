#!/usr/bin/env python3
"""Render street views along roads: semantic, instance and depth images, and camera poses.

    jobs/render_streets.py                                          the first generated scene
    jobs/render_streets.py --input DIR --split test --max-scenes 8 --spacing-m 0.5
    jobs/render_streets.py --input OUTPAINTED --max-frames 200      a longer drive
    jobs/render_streets.py --width-px 1408 --height-px 376          KITTI-360's own size

The camera drives on the right half of the road, parallel to the centreline of the road mask. The camera has the lens of
KITTI-360's image_00. For each scene, the job writes these files to OUTPUT/streets/<run>/<scene_id>/:

* PNG files in semantic/, class_id/, instance/, depth/ and shaded/. An instance value is the index of a primitive plus
  1. A depth value has 16 bits and a unit of 1/256 m; it is 0 beyond the range.
* cameras.json with poses, intrinsics and class ids.
* sheet.png and drive.webp with previews.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import run
from jobs.support.options import IfBusyOption, LogFormatOption, SceneOptions


@dataclass(frozen=True)
class Config(SceneOptions):
    max_scenes: int | None = 1
    """Maximum number of scenes; the first scenes are used."""
    output: str = ""
    """Directory in which the job writes streets/ (default: the input directory)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    run: str = "drive"
    """Name of the run and of its directory under streets/."""
    spacing_m: float = 1.0
    """Distance between consecutive frames in metres."""
    camera_height_m: float = 1.55
    """Height of the camera above the road in metres, as in KITTI-360."""
    pitch_deg: float = 0.0
    """Pitch of the camera in degrees; positive looks up."""
    width_px: int = 704
    """Image width in pixels; the field of view does not depend on it."""
    height_px: int = 188
    """Image height in pixels."""
    lateral_offset: float = 0.25
    """Offset of the camera to the right of the centreline, as a share of the road's width; negative is left."""
    max_frames: int | None = None
    """Maximum number of frames per scene (default: to the end of the road)."""


if __name__ == "__main__":
    run("render_streets")
