"""Implementation of jobs/export_scenes.py."""

from __future__ import annotations

from dataclasses import replace

from jobs.export_scenes import Config
from jobs.support.cli import make_absolute
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scene_requests import select_scenes
from pipelines.io.export import TRAFFIC_WRITERS, WRITERS, export_scenes, uses_traffic
from pipelines.runtime import storage


def export(config: Config) -> tuple[str, dict[str, int], dict[str, str]]:
    """Write files.

    Returns:
        The output directory, the number of files per format, and a mapping from the id of each unwritten scene to the
        reason.
    """
    if not config.formats:
        raise ValueError(f"--formats is empty, expected one or more of {', '.join((*WRITERS, *TRAFFIC_WRITERS))}")
    selection = select_scenes(config)
    tracks = make_absolute(config.tracks) if config.tracks else selection.root
    if uses_traffic(config.formats):
        missing = [
            shard for shard, _ in selection.shards() if not storage.exists(replace(shard, root=tracks).path("tracks"))
        ]
        if missing:
            shown = replace(missing[0], root=tracks).path("tracks")
            raise ValueError(
                f"{shown}: no such file. The formats animation and xosc need the table tracks of the scenes; write it "
                "with jobs/simulate_traffic.py, or pass its directory with --tracks"
            )
    output = make_absolute(config.output) if config.output else storage.join_uri(selection.root, "export")
    total = sum(len(rows) for _, rows in selection.shards())
    with hold_output(output, "export", config):
        with JobProgress() as bar:
            shown = bar.add_task("export scenes", total=total)
            made = export_scenes(
                selection, config.formats, output, config.overwrite, lambda count: bar.advance(shown, count), tracks
            )
        counts, skipped = made
        return output, {str(name): count for name, count in counts.items()}, skipped


def main(config: Config) -> None:
    output, counts, refused = export(config)
    print(f"{', '.join(f'{count} {kind}' for kind, count in counts.items())} files in {output}")
    for scene_id, reason in list(refused.items())[:5]:
        print(f"  not written: {scene_id}, {reason}")
    if len(refused) > 5:
        print(f"  and {len(refused) - 5} more, see {output}/rejects")
