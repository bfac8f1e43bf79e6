"""Implementation of jobs/render_streets.py."""

from __future__ import annotations

from jobs.render_streets import Config
from jobs.support.cli import make_absolute, resolve_path
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scene_requests import select_scenes
from pipelines.rendering.pinhole import Lens
from pipelines.rendering.street_views import StreetRequest, render_streets


def render(config: Config) -> dict[str, int]:
    """Render street views and return the number of frames by scene id."""
    numbers = {"--spacing-m": config.spacing_m, "--camera-height-m": config.camera_height_m}
    numbers |= {"--width-px": config.width_px, "--height-px": config.height_px, "--max-frames": config.max_frames or 1}
    for name, value in numbers.items():
        if not value > 0:
            raise ValueError(f"{name} is {value}, expected more than 0")
    if not -90 < config.pitch_deg < 90 or not -0.5 <= config.lateral_offset <= 0.5:
        raise ValueError(
            f"--pitch-deg is {config.pitch_deg}, --lateral-offset is {config.lateral_offset}: "
            "expected a pitch between -90 and 90 degrees, and an offset in [-0.5, 0.5]"
        )
    selection = select_scenes(config)
    total = sum(len(rows) for _, rows in selection.shards())
    request = StreetRequest(
        output=make_absolute(config.output) if config.output else selection.root,
        run=config.run,
        spacing_m=config.spacing_m,
        height_m=config.camera_height_m,
        pitch_deg=config.pitch_deg,
        lens=Lens().resize(config.width_px, config.height_px),
        right=config.lateral_offset,
        most=config.max_frames,
    )
    with hold_output(request.output, f"streets-{config.run}", config), JobProgress() as bar:
        shown = bar.add_task("render streets", total=total)
        return render_streets(request, selection, lambda: bar.advance(shown))


def main(config: Config) -> None:
    frames = render(config)
    directory = resolve_path(config.output or config.input, "generated")
    bare = [name for name, count in frames.items() if not count]
    print(f"{sum(frames.values())} frames of {len(frames)} scenes in {directory}/streets/{config.run}")
    if bare:
        print(f"{len(bare)} scenes have no road: {', '.join(bare[:5])}{', ...' if len(bare) > 5 else ''}")
