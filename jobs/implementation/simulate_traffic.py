"""Implementation of jobs/simulate_traffic.py."""

from __future__ import annotations

from dataclasses import asdict, replace

import pyarrow as pa

from jobs.implementation.checks import check_simulate_traffic
from jobs.simulate_traffic import Config
from jobs.support.cli import make_absolute
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scene_requests import select_scenes
from pipelines.rendering.street_views import encode_animation
from pipelines.rendering.traffic_view import render_traffic
from pipelines.reporting.report import Picture
from pipelines.reporting.traffic_report import count_failures, count_simulated, render_traffic_html, summarise_traffic
from pipelines.runtime import storage
from pipelines.schema.file_names import make_file_name
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard, find_shards
from pipelines.schema.tracks import read_tracks, select_tracks
from pipelines.traffic.dataset import TrafficRequest, simulate_dataset
from pipelines.traffic.demand import Demand

SPEED = 4.0  # Speed of moving pictures, compared with real time.
SCENES, CONTROL, REFERENCE = "scenes", "control: closed roads", "reference"


def read_traffic(shards: list[Shard], control: bool) -> pa.Table:
    """Return the rows of the table traffic of scenes or of their damaged copies."""
    table = pa.concat_tables([shard.read("traffic") for shard in shards])
    return table.filter(pa.array(table["control"].to_numpy() == control))


def write_videos(
    output: str, selection: SceneSubset, count: int, time_step_s: float
) -> tuple[list[Picture], list[str]]:
    """Write moving pictures of the first scenes with traffic; return a picture of each, and the names of the files."""
    pictures, names = [], []
    for shard, rows in selection.shards() if count else []:
        found = read_tracks(replace(shard, root=output))
        for scene in shard.scenes(rows[: count - len(pictures)]):
            tracks = select_tracks(found, scene.scene_id)
            if not len(tracks):
                continue
            frames = render_traffic(scene, tracks)
            names.append(f"traffic_videos/{make_file_name(scene.scene_id)}.webp")
            data = encode_animation(frames, SPEED / time_step_s)
            storage.write_whole(storage.join_uri(output, names[-1]), lambda stream, data=data: stream.write(data))
            pictures.append(Picture(scene.scene_id, frames[len(frames) // 2]))
        if len(pictures) == count:
            break
    return pictures, names


def main(config: Config) -> None:
    check_simulate_traffic(config)
    selection = select_scenes(config)
    output = make_absolute(config.output) if config.output else selection.root
    demand = Demand(config.duration_s, config.vehicles_per_min, config.pedestrians_per_min, config.time_step_s)
    request = TrafficRequest(output, demand, config.seed, config.slab_offset_m, config.control)
    reference = find_shards(make_absolute(config.reference), "traffic") if config.reference else []
    with hold_output(output, "traffic", config), JobProgress() as bar:
        shown = bar.add_task("simulate", total=sum(len(rows) for _, rows in selection.shards()))
        shards = simulate_dataset(request, selection, lambda count: bar.advance(shown, count))
        sets = {SCENES: read_traffic(shards, False)}
        if config.control:
            sets[CONTROL] = read_traffic(shards, True)
        if reference:
            sets[REFERENCE] = read_traffic(reference, False)
        pictures, videos = write_videos(output, selection, config.num_examples, config.time_step_s)
        options = asdict(demand) | {"seed": config.seed}
        page = storage.join_uri(output, "traffic.html")
        storage.write_text(render_traffic_html(sets, pictures, videos, options), page)
    for name, table in sets.items():
        scores = summarise_traffic(table)
        text = ", ".join(f"{key} {value.value:.3g}" for key, value in scores.items() if value is not None)
        print(f"{name} ({count_simulated(table)} of {len(table)}): {text or 'no scene could be simulated'}")
    for reason, count in list(count_failures(sets[SCENES]).items())[:5]:
        print(f"  {count} without simulation: {reason}")
    print(f"tables tracks and traffic, traffic.html{' and traffic_videos' if videos else ''} in {output}")
