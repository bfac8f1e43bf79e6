"""Render one page about a dataset directory: counts, sizes, poses and labels of its scenes, and rejected scenes.

All figures are computed from the tables. Slots, thresholds and the reports of the readers are read from dataset.json.
This file is optional: directories of generated scenes do not have it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from models.scene import CATEGORIES, DENSITIES, GROUND_CLASSES
from models.uris import split_name
from pipelines.reporting.chart import format_number
from pipelines.reporting.dataset_charts import (
    draw_count_histogram,
    draw_label_matrix,
    draw_share_bars,
    draw_size_ranges,
    draw_track_map,
    spell_name,
)
from pipelines.reporting.drawings_page import CaptionedSvg, DrawingsSection, render_page_html
from pipelines.reporting.report import Figure, KeyFigures, Picture, Pictures, Section, Table, Text
from pipelines.reporting.scene_index import Catalogue
from pipelines.runtime import storage
from pipelines.schema.tables import find_shards

PERCENTILES = (5, 25, 50, 75, 95)
SHOWN_REASONS, SHOWN_DEFECTS, SHOWN_SEQUENCES = 30, 50, 60
NBSP = "\u00a0"  # Non-breaking space.
SPLITS = ("train", "test", "unused", "generated")


# -------------------------------------------------------------------------------------------------------- facts


@dataclass(frozen=True, eq=False)
class DatasetFacts:
    """Contents of the page.

    Attributes:
        catalogue: Scenes of the dataset directory.
        grid_area_m2: (n,) area of the grid of each scene (m^2).
        sizes_m: (k, 3) length, width and height of all primitives of each category (m).
        labels: Number of primitives for each category and class label of the dataset.
        rejects: Rows of the rejects table.
        description: Content of dataset.json. None: there is no such file.
        records: Options of the run that generated a source, for each source.
    """

    catalogue: Catalogue
    grid_area_m2: np.ndarray
    sizes_m: dict[str, np.ndarray]
    labels: Counter
    rejects: list[dict]
    description: dict | None
    records: dict[str, dict]

    @property
    def counts(self) -> np.ndarray:
        """Return the number of primitives (n, 11) per scene and category."""
        return np.stack([self.catalogue.column(f"num_{name}") for name in CATEGORIES], axis=1)

    @property
    def categories(self) -> list[str]:
        """Return the categories that occur."""
        return [name for name in CATEGORIES if name in self.sizes_m]

    @property
    def slots(self) -> dict[str, int]:
        """Return the number of slots per category; the dictionary is empty if there is no dataset.json."""
        layout = self.description["layout"] if self.description else {"categories": (), "slots": ()}
        return dict(zip(layout["categories"], layout["slots"], strict=True))


def read_facts(
    root: str, source: str | None = None, split: str | None = None, on_shard: Callable[[int, int], None] | None = None
) -> DatasetFacts:
    """Read all tables of a dataset directory once.

    Args:
        root: Dataset directory.
        source: Source to read. None: all sources are read.
        split: Split to read. None: all splits are read.
        on_shard: Called after each shard with the number of finished shards and the total number of shards.

    Returns:
        Contents of the page.

    Raises:
        ValueError: The directory contains no scenes of this source and split.
    """
    catalogue = Catalogue.read(root, source, split)
    sizes: dict[str, list[np.ndarray]] = {name: [] for name in CATEGORIES}
    labels: Counter = Counter()
    areas = []
    for done, shard in enumerate(catalogue.shards, 1):
        grid = shard.read("rasters", ["rows", "cols", "resolution_m"])
        areas.append(grid["rows"].to_numpy() * grid["cols"].to_numpy() * grid["resolution_m"].to_numpy() ** 2)
        table = shard.read("primitives", ["category", "label", "length_m", "width_m", "height_m"])
        size = np.stack([table[f"{name}_m"].to_numpy() for name in ("length", "width", "height")], axis=1)
        category = table["category"].to_numpy()
        for name in np.unique(category) if len(category) else ():
            sizes[name].append(size[category == name])
        for row in table.group_by(["category", "label"]).aggregate([([], "count_all")]).to_pylist():
            labels[row["category"], row["label"]] += row["count_all"]
        if on_shard:
            on_shard(done, len(catalogue.shards))
    description = storage.join_uri(root, "dataset.json")
    records = {name: storage.join_uri(root, f"{name}.json") for name in sorted({s.source for s in catalogue.shards})}
    return DatasetFacts(
        catalogue=catalogue,
        grid_area_m2=np.concatenate(areas),
        sizes_m={name: np.concatenate(parts) for name, parts in sizes.items() if parts},
        labels=labels,
        rejects=read_rejects(root, source, split),
        description=storage.read_json(description) if storage.exists(description) else None,
        records={name: storage.read_json(path) for name, path in records.items() if storage.exists(path)},
    )


def read_rejects(root: str, source: str | None, split: str | None) -> list[dict]:
    """Return the rows of the rejects table; the list is empty if there is no such table."""
    if not storage.list_files(storage.join_uri(root, "rejects"), ".parquet"):
        return []
    shards = [s for s in find_shards(root, "rejects") if s.source == (source or s.source)]
    return [row for s in shards if s.split == (split or s.split) for row in s.read("rejects").to_pylist()]


# --------------------------------------------------------------------------------------------------------- page


def render_dataset_html(facts: DatasetFacts, scenes: Sequence[tuple[Picture, Picture]] = ()) -> str:
    """Render the whole page.

    Args:
        facts: Contents of the page.
        scenes: Two pictures per scene: an oblique view and a view from above.

    Returns:
        HTML page.
    """
    root = facts.catalogue.root.rstrip("/")
    sections = [
        make_totals(facts),
        *([draw_scene_pictures(scenes)] if scenes else []),
        *make_split_sections(facts),
        draw_histograms(facts),
        *make_size_sections(facts),
        draw_ground_shares(facts),
        *make_label_sections(facts),
        *make_reject_sections(facts),
        *make_reader_sections(facts),
        *make_provenance_sections(facts),
    ]
    return render_page_html(split_name(root)[1], sections, root)


def make_totals(facts: DatasetFacts) -> KeyFigures:
    """Make the key figures of the page."""
    catalogue, counts = facts.catalogue, facts.counts
    per_scene = counts.sum(axis=1)
    low, high = np.percentile(per_scene, [5, 95])
    sequences = len(set(catalogue.column("sequence")))
    figures = [
        Figure(
            len(catalogue),
            "scenes",
            ", ".join(f"{format_number(n)} {split}" for split, n in group_by_split(facts).items()),
        ),
        Figure(int(per_scene.sum()), "primitives", f"of {len(facts.categories)} from {len(CATEGORIES)} categories"),
        Figure(
            float(round(per_scene.mean(), 1)), "primitives per scene", f"{low:.0f} to {high:.0f} in 90 % of the scenes"
        ),
        Figure(sequences, "sequence" if sequences == 1 else "sequences"),
    ]
    if facts.description:
        figures.append(Figure(sum(facts.slots.values()), "slots in the tensors", f"{len(facts.slots)} categories"))
        share = len(facts.rejects) / (len(facts.rejects) + len(catalogue))
        figures.append(Figure(len(facts.rejects), "rejected scenes", f"{100 * share:.1f} % of all poses"))
    return KeyFigures("Summary", figures)


def group_by_split(facts: DatasetFacts) -> dict[str, int]:
    """Return the number of scenes per split, in the order of SPLITS."""
    found = Counter(facts.catalogue.column("split"))
    return {name: found[name] for name in sorted(found, key=lambda s: (SPLITS.index(s) if s in SPLITS else 9, s))}


def draw_scene_pictures(scenes: Sequence[tuple[Picture, Picture]]) -> Pictures:
    """Make rows of oblique views; below each row, the same scenes are shown from above."""
    columns, pictures = min(len(scenes), 4), []
    for start in range(0, len(scenes), columns):
        row = scenes[start : start + columns]
        pictures += [oblique for oblique, _ in row] + [above for _, above in row]
    note = "Each oblique view looks forward. Below it, the same scene is shown from above, with forward at the top."
    return Pictures("Example scenes", pictures, columns=columns, note=note)


def make_split_sections(facts: DatasetFacts) -> list[Section | DrawingsSection]:
    """Make the table of splits. If the poses are known, also make the map of splits."""
    catalogue = facts.catalogue
    source, split, sequence = (catalogue.column(name) for name in ("source", "split", "sequence"))
    per_scene, rows = catalogue.column("num_primitives"), []
    for key in sorted(
        set(zip(source, split, strict=True)), key=lambda k: (k[0], SPLITS.index(k[1]) if k[1] in SPLITS else 9)
    ):
        chosen = (source == key[0]) & (split == key[1])
        rows.append(
            (
                *key,
                int(chosen.sum()),
                f"{100 * chosen.mean():.1f}{NBSP}%",
                len(set(sequence[chosen])),
                per_scene[chosen].mean(),
            )
        )
    columns = ("source", "split", "scenes", "share", "sequences", "primitives per scene")
    sections: list[Section | DrawingsSection] = [Table("Splits", columns, rows)]
    position_m = np.stack([catalogue.column("x_m"), catalogue.column("y_m")], axis=1)
    if (np.ptp(position_m, axis=0) == 0).all():
        return sections
    tracks = {
        name: {
            part: position_m[(sequence == name) & (split == part)]
            for part in SPLITS
            if ((sequence == name) & (split == part)).any()
        }
        for name in sorted(set(sequence))
    }
    note = (
        "Each dot is the pose of a scene in the world frame, with x to the right and y upwards. All sequences have the "
        "same scale. The relative position of sequences on the map has no meaning."
    )
    return [*sections, DrawingsSection("Split map", [CaptionedSvg(draw_track_map(tracks))], "wide", note)]


def draw_histograms(facts: DatasetFacts) -> DrawingsSection:
    """Draw a histogram of counts per category; mark the slots and the 95th percentile, from which slots are derived."""
    training, drawings = facts.catalogue.column("split") == "train", []
    for k, name in enumerate(CATEGORIES):
        counts = facts.counts[:, k]
        marks, words = {}, [f"mean {counts.mean():.1f}"]
        if (counts == 0).any():
            words.append(f"zero in {100 * (counts == 0).mean():.0f} %")
        if name in facts.slots and training.any():
            marks["p95"] = float(np.ceil(np.percentile(counts[training], 95)).clip(1))
            marks["slots"] = float(facts.slots[name])
            words.append(f"over slots {100 * (counts[training] > facts.slots[name]).mean():.1f} %")
        if name in facts.categories or name in facts.slots:
            drawings.append(
                CaptionedSvg(
                    draw_count_histogram(name, counts, marks), " · ".join(part.replace(" ", NBSP) for part in words)
                )
            )
    note = (
        "Each histogram shows the number of scenes (vertical) by the number of primitives of a category (horizontal)."
    )
    if facts.description:
        note += (
            " The mark 'p95' shows the 95th percentile of the training split. The mark 'slots' shows the maximum "
            "number of primitives of a category in a tensor. If a scene has more primitives, the tensor keeps the "
            "nearest primitives. 'Over slots' is the share of training scenes with more primitives than slots."
        )
    return DrawingsSection("Primitives per scene", drawings, "small", note)


def make_size_sections(facts: DatasetFacts) -> list[Section | DrawingsSection]:
    """Show the ranges of length, width and height per category, as a drawing and as a table."""
    percentiles = {name: np.percentile(facts.sizes_m[name], PERCENTILES, axis=0) for name in facts.categories}
    if not percentiles:
        return [Text("Sizes", ["The scenes contain no primitives."])]
    note = (
        "Length is the longer side of the footprint. Thin lines extend from the 5th to the 95th percentile over all "
        "splits. Thick lines extend from the 25th to the 75th percentile, and dots mark the median."
    )
    rows = []
    for name, values in percentiles.items():
        spans = [f"{NBSP}·{NBSP}".join(map(_format_metres, column)) for column in values[[0, 2, 4]].T]
        total = len(facts.sizes_m[name])
        labels = sorted(((n, label) for (c, label), n in facts.labels.items() if c == name), reverse=True)
        text = (
            ", ".join(f"{label} {format_number(n)}" for n, label in labels)
            if [label for _, label in labels] != [name]
            else ""
        )
        rows.append((spell_name(name).replace(" ", NBSP), total, round(total / len(facts.catalogue), 2), *spans, text))
    columns = ("category", "primitives", "per scene", "length, m", "width, m", "height, m", "labels of the dataset")
    return [
        DrawingsSection("Sizes", [CaptionedSvg(draw_size_ranges(percentiles))], "wide", note),
        Table("Categories", columns, rows, note="Each size is given as 5th percentile · median · 95th percentile."),
    ]


def _format_metres(value: float) -> str:
    return f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def draw_ground_shares(facts: DatasetFacts) -> DrawingsSection:
    """Draw the mean share of the grid for each ground class and density label."""
    drawings = []
    for group in ("vegetation", "vehicle"):
        labels = facts.catalogue.column(f"{group}_density")
        shares: dict[str, dict[str, float]] = {}
        for name in GROUND_CLASSES:
            share = facts.catalogue.column(f"{name}_area_m2").astype(float) / facts.grid_area_m2
            chosen = {label: (labels == label) & np.isfinite(share) for label in (*DENSITIES, None)}
            shares[name] = {label or "no label": share[rows].mean() for label, rows in chosen.items() if rows.any()}
        drawings.append(CaptionedSvg(draw_share_bars(f"by {group} density", {n: by for n, by in shares.items() if by})))
    note = (
        "Each bar is the mean share of the area of a scene that a ground class covers. Classes may overlap, and a part "
        "of the area may have no class."
    )
    return DrawingsSection("Ground classes", drawings, "pairs", note)


def make_label_sections(facts: DatasetFacts) -> list[Section | DrawingsSection]:
    """Show the number of scenes for each split and pair of density labels, and the thresholds of the labels."""
    columns = [facts.catalogue.column(f"{group}_density") for group in ("vegetation", "vehicle")]
    names = [[*DENSITIES, *([None] if None in set(values) else [])] for values in columns]
    split, drawings = facts.catalogue.column("split"), []
    for part, total in group_by_split(facts).items():
        pairs = Counter(zip(*(values[split == part] for values in columns), strict=True))
        counts = np.array([[pairs[row, column] for column in names[1]] for row in names[0]])
        drawings.append(
            CaptionedSvg(draw_label_matrix(f"{part}, {format_number(total)} scenes", counts, *_name_rows(names)))
        )
    note = (
        "Each cell is the number of scenes with a pair of density labels. A label depends on the number and the "
        "total volume of the objects. The label is low if number and volume are below their 25th percentiles (p25). "
        "The label is high if number and volume are above their 75th percentiles (p75). All other scenes have the "
        "label medium."
    )
    if not facts.description:
        note = "Each cell is the number of scenes with a pair of requested density labels."
        return [DrawingsSection("Density labels", drawings, "small", note)]
    found = {group: facts.description[f"{group}_thresholds"] for group in ("vegetation", "vehicle")}
    keys = list(found["vegetation"])
    heads = ("label", *(key.replace("_m3", ", m³").replace("_", " ") for key in keys))
    rows = [(group, *(values[key] for key in keys)) for group, values in found.items()]
    return [
        DrawingsSection("Density labels", drawings, "small", note),
        Table("Thresholds of density labels", heads, rows, note="The thresholds come from the training split."),
    ]


def _name_rows(names: Sequence[Sequence[str | None]]) -> tuple[list[str], list[str]]:
    first, second = ([label or "none" for label in labels] for labels in names)
    return first, second


def make_reject_sections(facts: DatasetFacts) -> list[Section]:
    """Tabulate the reasons for rejected scenes."""
    if not facts.rejects:
        return [Text("Rejected scenes", ["No pose was rejected."])] if facts.description else []
    reasons: dict[str, list[dict]] = {}
    for row in facts.rejects:
        reasons.setdefault(row["reason"], []).append(row)
    ordered = sorted(reasons.items(), key=lambda item: -len(item[1]))
    rows = [
        (len(found), reason, len({row["sequence"] for row in found}), found[0]["scene_id"])
        for reason, found in ordered[:SHOWN_REASONS]
    ]
    more = f"The table shows the {SHOWN_REASONS} most frequent of {len(ordered)} reasons."
    note = more if len(ordered) > SHOWN_REASONS else ""
    return [Table("Rejected scenes", ("scenes", "reason", "sequences", "example"), rows, note=note)]


def make_reader_sections(facts: DatasetFacts) -> list[Section]:
    """Tabulate the objects that the readers of raw drives excluded, per sequence, label and defect."""
    reports: Mapping[str, Mapping] = (facts.description or {}).get("reports") or {}
    if not reports:
        return []
    names = list(dict.fromkeys(name for report in reports.values() for name in report))

    def amount(value: Any) -> int | None:
        if isinstance(value, Mapping):
            return sum(value.values())
        return len(value) if isinstance(value, list) else value

    per_sequence = {s: {name: amount(report.get(name)) for name in names} for s, report in sorted(reports.items())}
    rows = [(sequence, *found.values()) for sequence, found in list(per_sequence.items())[:SHOWN_SEQUENCES]]
    if len(per_sequence) > 1:
        rows.insert(0, ("all", *(sum(found[name] or 0 for found in per_sequence.values()) for name in names)))
    sections: list[Section] = [
        Table(
            "Objects in the raw files",
            ("sequence", *map(spell_name, names)),
            rows,
            note="Dropped objects have a known label without a category. Unknown objects have a label that no table "
            "lists. Duplicates are objects that a file contains twice. Defects are objects that cannot be read.",
        )
    ]
    labels: Counter = Counter()
    for report in reports.values():
        for name, value in report.items():
            if isinstance(value, Mapping):
                labels.update({(name, label): count for label, count in value.items()})
    if labels:
        rows = [(label, name, count) for (name, label), count in labels.most_common()]
        sections.append(Table("Excluded labels", ("label", "reason", "objects"), rows))
    defects = [
        (s, d) for s, report in sorted(reports.items()) for v in report.values() if isinstance(v, list) for d in v
    ]
    if defects:
        columns = list(defects[0][1])
        rows = [(sequence, *(defect.get(name) for name in columns)) for sequence, defect in defects[:SHOWN_DEFECTS]]
        more = f"The table shows the first {SHOWN_DEFECTS} of {len(defects)} objects."
        note = more if len(defects) > SHOWN_DEFECTS else ""
        sections.append(Table("Defective objects", ("sequence", *columns), rows, note=note))
    return sections


def make_provenance_sections(facts: DatasetFacts) -> list[Section]:
    """Tabulate the options of the run that wrote each source."""
    made = {facts.description["source"]: facts.description["options"]} if facts.description else {}
    sections: list[Section] = []
    for source, options in (made | facts.records).items():
        rows = [(name, _convert_to_plain(value)) for name, value in options.items()]
        sections.append(Table(f"Options of {source}", ("option", "value"), rows))
    return sections


def _convert_to_plain(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_convert_to_plain(part)}" for name, part in value.items())
    return ", ".join(map(_convert_to_plain, value)) if isinstance(value, list) else "–" if value is None else str(value)
