#!/usr/bin/env python3
"""Look at a dataset directory, real or generated: pictures of scenes, sheets of many, a page of statistics.

    jobs/inspect_scenes.py scene town-00002-0000000035 --dataset DIR       one PNG with every view; --glb for the mesh
    jobs/inspect_scenes.py scene --count 5 --seed 1 --dataset DIR          five scenes at random
    jobs/inspect_scenes.py sheet --dataset DIR --sort vegetation           64 scenes from bare to overgrown
    jobs/inspect_scenes.py sheet --dataset DIR --sort num_human --pick highest --view 3d
    jobs/inspect_scenes.py report --dataset DIR                            one self-contained HTML page
    jobs/inspect_scenes.py gallery --dataset DIR --count 200               another: filters, every scene in 3D

Reads the tables only. Files go to $PRITTI_HOME/inspect/<dataset> unless --output says otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from jobs.support.cli import absolute, home, run, start_ray

if TYPE_CHECKING:
    import numpy as np

    from pipelines.reporting.scene_index import Catalogue


@dataclass(frozen=True)
class OneScene:
    """Scenes in every view: from above, in 3D, ground classes, ground height, primitives; one PNG each."""

    ids: tyro.conf.Positional[tuple[str, ...]] = ()
    """Scene ids; without one, --count scenes at random."""
    dataset: str = ""
    """Dataset directory or URI (default: $PRITTI_HOME/datasets/town)."""
    source: str = ""
    """Only this source (default: whatever is there)."""
    split: str = ""
    """Only this split (default: whatever is there)."""
    count: int = 1
    """How many at random, at most, if no id is given."""
    seed: int = 0
    """Which at random."""
    glb: bool = False
    """Also write each scene's mesh as <id>.glb."""
    output: str = ""
    """Directory for the files."""


@dataclass(frozen=True)
class Sheet:
    """Many scenes on one picture."""

    dataset: str = ""
    """Dataset directory or URI (default: $PRITTI_HOME/datasets/town)."""
    source: str = ""
    """Only this source (default: whatever is there)."""
    split: str = ""
    """Only this split (default: whatever is there)."""
    count: int = 64
    """How many scenes, at most."""
    sort: str = "drive"
    """drive (by sequence and frame), random, vegetation, vehicles, primitives, or a numeric column of the scenes
    table, such as num_pole or road_area_m2."""
    pick: Literal["spread", "lowest", "highest"] = "spread"
    """Which of the sorted scenes: evenly spread, the first or the last."""
    view: Literal["bev", "3d"] = "bev"
    """From above or oblique."""
    size: int = 256
    """Pixels across each picture."""
    columns: int = 0
    """Pictures side by side (default: about 5 : 4 in all)."""
    seed: int = 0
    """Which scenes, for --sort random."""
    output: str = ""
    """The PNG to write."""


@dataclass(frozen=True)
class Report:
    """One HTML page: totals, splits, counts, sizes, ground, labels, rejects, a few scenes."""

    dataset: str = ""
    """Dataset directory or URI (default: $PRITTI_HOME/datasets/town)."""
    source: str = ""
    """Only this source (default: whatever is there)."""
    split: str = ""
    """Only this split (default: whatever is there)."""
    pictures: int = 8
    """Scenes to show, from least to most vegetation; with 0 the job runs without Ray."""
    output: str = ""
    """The HTML file to write."""


@dataclass(frozen=True)
class Gallery:
    """One HTML page to put online: scenes to filter by label and statistics, each in 3D. About 35 kB a scene."""

    dataset: str = ""
    """Dataset directory or URI (default: $PRITTI_HOME/datasets/town)."""
    source: str = ""
    """Only this source (default: whatever is there)."""
    split: str = ""
    """Only this split (default: whatever is there)."""
    count: int = 100
    """How many scenes, at most, evenly spread over the dataset."""
    title: str = "Scenes"
    """Of the page."""
    output: str = ""
    """The HTML file to write."""


Config = (
    Annotated[OneScene, tyro.conf.subcommand("scene")]
    | Annotated[Sheet, tyro.conf.subcommand("sheet")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Gallery, tyro.conf.subcommand("gallery")]
)


def directory(config: OneScene | Sheet | Report | Gallery) -> str:
    return absolute(config.dataset) if config.dataset else home("datasets", "town")


def destination(config: OneScene | Sheet | Report | Gallery, name: str) -> str:
    """--output, or a place under $PRITTI_HOME named after the dataset."""
    if config.output:
        return absolute(config.output)
    return home("inspect", directory(config).rstrip("/").rsplit("/", 1)[-1], name).rstrip("/")


def draw_scenes(config: OneScene) -> list[str]:
    """Write the PNGs, and GLBs, and return their paths."""
    from rich.progress import Progress

    from pipelines.io.mesh_export import scene_glb
    from pipelines.rendering.render import png
    from pipelines.reporting.contact_sheet import scene_plate
    from pipelines.reporting.scene_index import Catalogue
    from pipelines.runtime import storage

    if config.count < 1:
        raise ValueError(f"--count is {config.count}, expected at least 1")
    catalogue = Catalogue.read(directory(config), config.source or None, config.split or None)
    chosen = catalogue.find(config.ids) if config.ids else catalogue.draw(config.count, config.seed)
    written = []
    with Progress() as bar:
        shown = bar.add_task("draw scenes", total=len(chosen))
        for shard, rows, _ in catalogue.chunks(chosen, 8):
            for scene in shard.scenes(rows):
                files = {"png": png(scene_plate(scene)[0])} | ({"glb": scene_glb(scene)} if config.glb else {})
                for kind, content in files.items():
                    written.append(storage.join(destination(config, ""), f"{scene.scene_id}.{kind}"))
                    storage.write_whole(written[-1], lambda stream, content=content: stream.write(content))
                bar.advance(shown)
    return written


def painted(catalogue: Catalogue, chosen: np.ndarray, views: tuple) -> list[list[np.ndarray]]:
    """Pictures of the chosen scenes, drawn by Ray under a progress bar."""
    from rich.progress import Progress

    from pipelines.reporting.contact_sheet import paint

    start_ray()
    with Progress() as bar:
        shown = bar.add_task("draw pictures", total=len(chosen) * len(views))
        return paint(catalogue, chosen, views, lambda: bar.advance(shown))


def draw_sheet(config: Sheet) -> str:
    """Write the sheet and return its path."""
    from pipelines.rendering.render import png
    from pipelines.reporting.contact_sheet import View, captions, scene_sheet, sheet_title
    from pipelines.reporting.scene_index import Catalogue
    from pipelines.runtime import storage

    for name in ("count", "size"):
        if getattr(config, name) < 1:
            raise ValueError(f"--{name} is {getattr(config, name)}, expected at least 1")
    catalogue = Catalogue.read(directory(config), config.source or None, config.split or None)
    chosen = catalogue.choose(config.count, config.sort, config.pick, config.seed)
    pictures = [picture for (picture,) in painted(catalogue, chosen, (View(config.view, config.size),))]
    title = sheet_title(catalogue, len(chosen), config.sort, config.pick)
    sheet = scene_sheet(pictures, captions(catalogue, chosen, config.sort), title, config.columns or None)
    path = destination(config, "sheet.png")
    storage.write_whole(path, lambda stream: stream.write(png(sheet)))
    return path


def write_page(config: Report) -> str:
    """Write the page and return its path."""
    from rich.progress import Progress

    from pipelines.reporting.contact_sheet import View, captions
    from pipelines.reporting.dataset_report import dataset_html, read_facts
    from pipelines.reporting.report import Picture
    from pipelines.runtime import storage

    with Progress() as bar:
        shown = bar.add_task("read tables", total=None)
        facts = read_facts(
            directory(config),
            config.source or None,
            config.split or None,
            lambda done, total: bar.update(shown, completed=done, total=total),
        )
    scenes = []
    if config.pictures > 0:
        catalogue = facts.catalogue
        chosen = catalogue.choose(config.pictures, "vegetation")
        named = captions(catalogue, chosen, "vegetation")
        for (oblique, above), (name, remark) in zip(
            painted(catalogue, chosen, (View("3d", 640), View("bev", 384))), named, strict=True
        ):
            scenes.append((Picture(name, oblique), Picture(remark, above)))
    html = dataset_html(facts, scenes)
    path = destination(config, "report.html")
    storage.write_text(html, path)
    return path


def write_gallery(config: Gallery) -> str:
    """Write the page and return its path."""
    from rich.progress import Progress

    from pipelines.reporting.scene_index import Catalogue
    from pipelines.reporting.gallery_page import gallery_html
    from pipelines.runtime import storage

    if config.count < 1:
        raise ValueError(f"--count is {config.count}, expected at least 1")
    catalogue = Catalogue.read(directory(config), config.source or None, config.split or None)
    chosen = catalogue.choose(config.count, "drive")
    start_ray()
    with Progress() as bar:
        shown = bar.add_task("pack scenes", total=len(chosen))
        html = gallery_html(catalogue, chosen, config.title, lambda: bar.advance(shown))
    path = destination(config, "gallery.html")
    storage.write_text(html, path)
    return path


def main(config: OneScene | Sheet | Report | Gallery) -> None:
    if isinstance(config, OneScene):
        print("\n".join(draw_scenes(config)))
    elif isinstance(config, Gallery):
        print(write_gallery(config))
    else:
        print(draw_sheet(config) if isinstance(config, Sheet) else write_page(config))


if __name__ == "__main__":
    run(main, Config, description=__doc__)
