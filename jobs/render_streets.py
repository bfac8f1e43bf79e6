#!/usr/bin/env python3
"""Drive a camera along the roads of scenes: semantic, instance and depth images, camera poses, a moving picture.

    jobs/render_streets.py                                          the first generated scene
    jobs/render_streets.py --input DIR --split test --limit 8 --spacing-m 0.5
    jobs/render_streets.py --input OUTPAINTED --frames 200          a longer drive
    jobs/render_streets.py --width 1408 --height 376                KITTI-360's own size

The way is the centreline of the road mask, on its right half; the lens KITTI-360's image_00. Per scene, under
OUTPUT/streets/<run>/<scene_id>/: semantic/, class_id/, instance/ (number of the primitive + 1), depth/ (16 bits, 256 to the
metre, 0 beyond) and shaded/ PNGs, cameras.json (poses, intrinsics, class ids), sheet.png and drive.webp.
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.support.cli import absolute, home, run, start_ray


@dataclass(frozen=True)
class Config:
    input: str = ""
    """Dataset directory with the scenes (default: $PRITTI_HOME/generated)."""
    source: str = ""
    """Source of the scenes (default: whatever is there)."""
    split: str = ""
    """Split of the scenes (default: whatever is there)."""
    limit: int = 1
    """How many scenes, from the first on."""
    output: str = ""
    """Where streets/ goes (default: the input directory)."""
    run: str = "drive"
    """Name of the run, a directory under streets/."""
    spacing_m: float = 1.0
    """Between two frames."""
    camera_height_m: float = 1.55
    """Above the road; KITTI-360's 1.55 m."""
    pitch_deg: float = 0.0
    """Above 0 looks up."""
    width: int = 704
    """Pixels; the lens is KITTI-360's whatever the size."""
    height: int = 188
    right: float = 0.25
    """How far right of the centreline, as a share of the road's width; below 0 left."""
    frames: int | None = None
    """At most so many of a scene (default: to the end of the road)."""


def render(config: Config) -> dict[str, int]:
    """Render and return the number of frames by scene id."""
    numbers = {"--spacing-m": config.spacing_m, "--camera-height-m": config.camera_height_m}
    numbers |= {"--width": config.width, "--height": config.height, "--frames": config.frames or 1}
    for name, value in numbers.items():
        if not value > 0:
            raise ValueError(f"{name} is {value}, expected more than 0")
    if not -90 < config.pitch_deg < 90 or not -0.5 <= config.right <= 0.5:
        raise ValueError(
            f"--pitch-deg is {config.pitch_deg}, --right {config.right}: expected -90 to 90, and -0.5 to 0.5"
        )
    from pipelines.schema.scene_subset import Selection

    directory = absolute(config.input) if config.input else home("generated")
    selection = Selection(directory, config.source or None, config.split or None, config.limit, "first")
    total = sum(len(rows) for _, rows in selection.shards())
    from rich.progress import Progress

    from pipelines.rendering.pinhole import Lens
    from pipelines.rendering.street_views import StreetRequest, render_streets

    request = StreetRequest(
        output=absolute(config.output) if config.output else directory,
        run=config.run,
        spacing_m=config.spacing_m,
        height_m=config.camera_height_m,
        pitch_deg=config.pitch_deg,
        lens=Lens().resized(config.width, config.height),
        right=config.right,
        most=config.frames,
    )
    start_ray()
    with Progress() as bar:
        shown = bar.add_task("render streets", total=total)
        return render_streets(request, selection, lambda: bar.advance(shown))


def main(config: Config) -> None:
    frames = render(config)
    directory = absolute(config.output or config.input) if config.output or config.input else home("generated")
    bare = [name for name, count in frames.items() if not count]
    print(f"{sum(frames.values())} frames of {len(frames)} scenes in {directory}/streets/{config.run}")
    if bare:
        print(f"{len(bare)} scenes have no road to drive on: {', '.join(bare[:5])}{', ...' if len(bare) > 5 else ''}")


if __name__ == "__main__":
    run(main, Config, description=__doc__)
