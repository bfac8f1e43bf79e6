"""Implementation of jobs/inspect_scenes.py."""

from __future__ import annotations

import sys

import numpy as np
from rich.progress import Progress

from jobs.inspect_scenes import DatasetOptions, Gallery, OneScene, Report, Sheet
from jobs.support.cli import home_path, make_absolute, require_positive, resolve_path
from jobs.support.ray_session import start_ray
from models.uris import split_name
from pipelines.io.mesh_export import export_glb
from pipelines.rendering.render import encode_png
from pipelines.reporting.contact_sheet import (
    View,
    draw_scene_plate,
    draw_scene_sheet,
    make_captions,
    make_sheet_title,
    paint_scene,
)
from pipelines.reporting.dataset_report import read_facts, render_dataset_html
from pipelines.reporting.gallery_page import render_gallery_html
from pipelines.reporting.report import Picture
from pipelines.reporting.scene_index import Catalogue
from pipelines.runtime import storage
from pipelines.schema.file_names import make_file_name


def find_dataset_directory(config: DatasetOptions) -> str:
    """Return the directory of --dataset, or the default."""
    return resolve_path(config.dataset, "datasets", "town")


def make_output_path(config: OneScene | Sheet | Report | Gallery, name: str) -> str:
    """Return the value of --output, or a path under $PRITTI_HOME that contains the name of the dataset."""
    if config.output:
        return make_absolute(config.output)
    return home_path("inspect", split_name(find_dataset_directory(config))[1], name).rstrip("/")


def read_catalogue(config: OneScene | Sheet | Gallery) -> Catalogue:
    """Read the scenes tables of --dataset. Damaged shards are left out with a warning."""
    catalogue = Catalogue.read(
        find_dataset_directory(config), config.source or None, config.split or None, skip_damaged=True
    )
    warn_of_damage(catalogue.damaged)
    return catalogue


def drop_damaged(catalogue: Catalogue, chosen: np.ndarray) -> np.ndarray:
    """Return the indices of scenes whose tables are valid. The others are left out with a warning."""
    kept, damaged = catalogue.drop_damaged(chosen)
    warn_of_damage(damaged)
    return kept


def warn_of_damage(reasons: dict[str, str]) -> None:
    """Print the reason for each shard that is left out."""
    for reason in reasons.values():
        print(f"left out: {reason}", file=sys.stderr)


def draw_scenes(config: OneScene) -> list[str]:
    """Write PNG and GLB files and return their paths."""
    require_positive(config, "max_scenes")
    catalogue = read_catalogue(config)
    chosen = catalogue.find(config.ids) if config.ids else catalogue.draw(config.max_scenes, config.seed)
    chosen = drop_damaged(catalogue, chosen)
    written, directory = [], make_output_path(config, "")
    with Progress() as bar:
        shown = bar.add_task("draw scenes", total=len(chosen))
        for shard, rows, _ in catalogue.chunks(chosen, 8):
            for scene in shard.scenes(rows):
                files = {"png": encode_png(draw_scene_plate(scene)[0])} | (
                    {"glb": export_glb(scene)} if config.glb else {}
                )
                for kind, content in files.items():
                    written.append(storage.join_uri(directory, f"{make_file_name(scene.scene_id)}.{kind}"))
                    storage.write_whole(written[-1], lambda stream, content=content: stream.write(content))
                bar.advance(shown)
    return written


def draw_pictures(catalogue: Catalogue, chosen: np.ndarray, views: tuple) -> list[list[np.ndarray]]:
    """Draw the chosen scenes with Ray and show a progress bar."""
    start_ray()
    with Progress() as bar:
        shown = bar.add_task("draw pictures", total=len(chosen) * len(views))
        return paint_scene(catalogue, chosen, views, lambda: bar.advance(shown))


def draw_sheet(config: Sheet) -> str:
    """Write the sheet and return its path."""
    require_positive(config, "max_scenes", "size_px")
    catalogue = read_catalogue(config)
    chosen = drop_damaged(catalogue, catalogue.choose(config.max_scenes, config.sort, config.pick, config.seed))
    pictures = [picture for (picture,) in draw_pictures(catalogue, chosen, (View(config.view, config.size_px),))]
    title = make_sheet_title(catalogue, len(chosen), config.sort, config.pick)
    sheet = draw_scene_sheet(pictures, make_captions(catalogue, chosen, config.sort), title, config.num_columns or None)
    path = make_output_path(config, "sheet.png")
    storage.write_whole(path, lambda stream: stream.write(encode_png(sheet)))
    return path


def write_dataset_report(config: Report) -> str:
    """Write the page and return its path."""
    with Progress() as bar:
        shown = bar.add_task("read tables", total=None)
        facts = read_facts(
            find_dataset_directory(config),
            config.source or None,
            config.split or None,
            lambda done, total: bar.update(shown, completed=done, total=total),
        )
    scenes = []
    if config.num_examples > 0:
        catalogue = facts.catalogue
        chosen = catalogue.choose(config.num_examples, "vegetation")
        named = make_captions(catalogue, chosen, "vegetation")
        for (oblique, above), (name, remark) in zip(
            draw_pictures(catalogue, chosen, (View("3d", 640), View("bev", 384))), named, strict=True
        ):
            scenes.append((Picture(name, oblique), Picture(remark, above)))
    html = render_dataset_html(facts, scenes)
    path = make_output_path(config, "report.html")
    storage.write_text(html, path)
    return path


def write_gallery(config: Gallery) -> str:
    """Write the page and return its path."""
    require_positive(config, "max_scenes")
    catalogue = read_catalogue(config)
    chosen = drop_damaged(catalogue, catalogue.choose(config.max_scenes, "drive"))
    start_ray()
    with Progress() as bar:
        shown = bar.add_task("pack scenes", total=len(chosen))
        html = render_gallery_html(catalogue, chosen, config.title, lambda: bar.advance(shown))
    path = make_output_path(config, "gallery.html")
    storage.write_text(html, path)
    return path


def main(config: OneScene | Sheet | Report | Gallery) -> None:
    if isinstance(config, OneScene):
        print("\n".join(draw_scenes(config)))
    elif isinstance(config, Gallery):
        print(write_gallery(config))
    else:
        print(draw_sheet(config) if isinstance(config, Sheet) else write_dataset_report(config))
