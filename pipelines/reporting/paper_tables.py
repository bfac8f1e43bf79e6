"""Tables of the paper with the scores of a reproduction next to the paper's numbers.

Each row has the place of the number in the paper, its value there, the reproduced value, and the value of the ceiling
and of a control from the same run, if they exist. The remark names differences of protocol and missing values.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from pipelines.metrics.two_sample import FOLDS, MIN_SCENES
from pipelines.reporting.report import Cell, Table

MIB = 2**20  # The paper's MB.
MEMORY = "memory_bytes"


@dataclass(frozen=True)
class PaperNumber:
    """One number of the paper.

    Attributes:
        table: Table or section of the paper.
        name: Name of the score with its unit.
        source: Dataset, "kitti360" or "av2".
        value: Number in the paper; None: the paper has no such number.
        score: Path of the score in metrics.json of the reproduction, separated by dots.
        factor: Factor from the reproduced score to the unit of the paper.
        needs: Option that the score needs: "inception", "vgg16" or "".
        transformer: Transformer of a generation score, "b", "l" or "xl"; "": a score of the layout VAE.
    """

    table: str
    name: str
    source: str
    value: float | None
    score: str
    factor: float = 1.0
    needs: str = ""
    transformer: str = ""


VOXELS, LVAE, GENERATION, AV2, MEMORISATION = (
    "Tab. 1, voxel reconstruction",
    "Tab. 2, layout VAE",
    "Tab. 3, generation",
    "supplement, Argoverse 2",
    "supplement G, distance to the nearest training scene",
)


# Scores that the paper does not report: FID of the scenes of precision and recall, which has a ceiling, and scores that
# need no weights.
FURTHER = (
    ("FID of the scenes of precision and recall", "fid_small"),
    ("AUC of a classifier, 0.5 is perfect", "two_sample_auc"),
    ("Fréchet distance of relations", "relation_frechet"),
)


def _list_generation() -> Iterator[PaperNumber]:
    rows = {"b": (0.712, 0.491, 73.952, 3.856), "l": (0.807, 0.545, 71.028, 4.210), "xl": (0.812, 0.616, 71.735, 3.964)}
    for source, table, found in (("kitti360", GENERATION, rows), ("av2", AV2, {"b": (0.572, 0.410, 144.330, 2.878)})):
        for size, (precision, recall, fid, inception_score) in found.items():
            for name, value, score in (
                ("precision", precision, "precision_k3"),
                ("recall", recall, "recall_k3"),
                ("FID", fid, "fid"),
                ("Inception score", inception_score, "inception_score"),
            ):
                label = f"{name}, DiT-{size.upper()}"
                yield PaperNumber(table, label, source, value, score, needs="inception", transformer=size)
            for name, score in FURTHER:
                needs = "inception" if "fid" in score else ""
                label = f"{name}, DiT-{size.upper()}"
                yield PaperNumber(table, label, source, None, score, needs=needs, transformer=size)
            if source == "kitti360":
                seconds = {"b": 0.58, "l": 1.78, "xl": 2.11}[size]
                label = f"time per scene (s), DiT-{size.upper()}"
                yield PaperNumber(table, label, source, seconds, "seconds", transformer=size)
                if size == "b":
                    label = "peak GPU memory of sampling (GB), DiT-B"
                    yield PaperNumber(table, label, source, 0.89, "peak_gb", transformer=size)


def _list_memorisation() -> Iterator[PaperNumber]:
    """List the distances of VGG16 features. The distances between training scenes are the reference."""
    for side, values in {"generated": (52.2, 51.7, 27.2, 115.7), "real": (22.5, 22.0, 4.9, 58.7)}.items():
        for score, value in zip(("mean", "median", "minimum", "maximum"), values, strict=True):
            path = f"memorisation.{side}.{score}"
            label = f"{'generated' if side == 'generated' else 'training'} scenes, {score}"
            yield PaperNumber(MEMORISATION, label, "kitti360", value, path, needs="vgg16", transformer="b")


def _list_ablation() -> Iterator[PaperNumber]:
    rows = {
        "without latent split": (3.55, 99.70, 53.78, 39.09),
        "without objects": (0.59, 99.96, None, None),
        "without ground": (None, None, 60.28, 46.37),
    }
    scores = (
        ("height MSE (0.01)", "height_mse_normalised"),
        ("ground IoU (%)", "ground_iou"),
        ("AP3D (%)", "ap3d"),
        ("AP3D@50 (%)", "ap3d_50"),
    )
    for variant, values in rows.items():
        for (name, score), value in zip(scores, values, strict=True):
            if value is not None:
                path = f"ablation.{variant}.{score}_mean"
                yield PaperNumber(LVAE, f"{name}, {variant}", "kitti360", value, path, 100.0)


PAPER_NUMBERS: tuple[PaperNumber, ...] = (
    PaperNumber(VOXELS, "IoU (%)", "kitti360", 90.58, "voxels.iou", 100.0),
    PaperNumber(VOXELS, "mIoU (%)", "kitti360", 70.27, "voxels.miou", 100.0),
    PaperNumber(VOXELS, "rasters of a scene (MB)", "kitti360", 2.50, f"{MEMORY}.rasters", 1 / MIB),
    PaperNumber(VOXELS, "primitives of a scene (MB)", "kitti360", 0.02, f"{MEMORY}.vectors", 1 / MIB),
    PaperNumber(LVAE, "height MSE (0.01)", "kitti360", 0.75, "height_mse_normalised", 100.0),
    PaperNumber(LVAE, "ground IoU (%)", "kitti360", 99.96, "ground_iou", 100.0),
    PaperNumber(LVAE, "AP3D (%)", "kitti360", 62.12, "ap3d", 100.0),
    PaperNumber(LVAE, "AP3D@50 (%)", "kitti360", 46.96, "ap3d_50", 100.0),
    PaperNumber(AV2, "height MSE (0.01)", "av2", 0.015, "height_mse_normalised", 100.0),
    PaperNumber(AV2, "ground IoU (%)", "av2", 99.98, "ground_iou", 100.0),
    PaperNumber(AV2, "AP3D (%)", "av2", 56.495, "ap3d", 100.0),
    PaperNumber(AV2, "AP3D@50 (%)", "av2", 39.490, "ap3d_50", 100.0),
    *_list_ablation(),
    *_list_generation(),
    *_list_memorisation(),
)


def find_score(scores: Mapping, path: str) -> float | None:
    """Return a score by its path, or None if the run did not compute it.

    Args:
        scores: Nested scores; a leaf is a number or a mapping with the key "value".
        path: Names of the nested entries, separated by dots.

    Returns:
        The score.
    """
    found: object = scores
    for name in path.split("."):
        if not isinstance(found, Mapping) or name not in found:
            return None
        found = found[name]
    if isinstance(found, Mapping):
        found = found.get("value")
    return float(found) if isinstance(found, int | float) else None


@dataclass(frozen=True)
class Reproduced:
    """Scores of a reproduction.

    Attributes:
        reconstruction: Scores of the layout VAE (`evaluate_reconstruction`), of its ceiling and of its control, by the
            names "ours", "ceiling" and "control". Scores of ablations are in the entry "ours" under "ablation" and the
            name of the variant.
        generation: Scores of each transformer by its size. They contain the scores of both protocols.
        notes: Remarks by path of the score, for example the number of scenes.
    """

    reconstruction: Mapping[str, Mapping]
    generation: Mapping[str, Mapping]
    notes: Mapping[str, str]


def compare_with_paper(source: str, found: Reproduced) -> list[dict]:
    """Return one row per number of the paper, and rows of scores that the paper does not report.

    Args:
        source: Dataset, "kitti360" or "av2".
        found: Scores of the reproduction.

    Returns:
        Rows with the keys table, name, paper, ours, ceiling, control, note. A number that does not exist is None. The
        note says why the reproduced number is missing.
    """
    rows = []
    for number in PAPER_NUMBERS:
        if number.source != source or (number.value is None and number.transformer not in found.generation):
            continue
        if number.transformer:
            scores = found.generation.get(number.transformer, {})
            sides = [scores, scores.get("sets", {}).get("ceiling", {}), scores.get("sets", {}).get("moved", {})]
        else:
            sides = [found.reconstruction.get(name, {}) for name in ("ours", "ceiling", "control")]
        paths = (number.score, *[find_ceiling_path(number.score)] * 2)
        ours, ceiling, control = (
            None if (value := find_score(side, path)) is None else value * number.factor
            for side, path in zip(sides, paths, strict=True)
        )
        note = found.notes.get(number.score, "")
        if number.score.startswith(MEMORY):
            ceiling = control = None
            note = note or "a size has no ceiling"
        if number.transformer and number.transformer not in found.generation:
            note = f"not trained; add --transformers {number.transformer}"
        elif ours is None:
            note = f"needs --{number.needs} FILE" if number.needs else note or _explain_missing(number)
        row = {"table": number.table, "name": number.name, "paper": number.value, "ours": ours}
        rows.append(row | {"ceiling": ceiling, "control": control, "note": note})
    return rows


def find_ceiling_path(path: str) -> str:
    """Return the path of the score of ceiling and control that belongs to a score.

    Ablations are evaluated on the same scenes as the full layout VAE and have the same ceiling and control.
    """
    return path.rpartition(".")[2].removesuffix("_mean") if path.startswith("ablation.") else path


def _explain_missing(number: PaperNumber) -> str:
    if number.score.startswith("ablation."):
        return "needs --ablations"
    if number.score == "two_sample_auc":
        return f"needs {MIN_SCENES} scenes and {FOLDS} places per side"
    return "benchmarks/gpu.py measures it" if number.score in ("seconds", "peak_gb") else "not computed"


def build_paper_tables(rows: Sequence[Mapping]) -> list[Table]:
    """Return one table per table of the paper.

    Args:
        rows: Output of `compare_with_paper`.

    Returns:
        The tables.
    """
    columns = ("score", "paper", "here", "ceiling", "control", "remark")
    tables = []
    for title in dict.fromkeys(row["table"] for row in rows):
        cells: list[Sequence[Cell]] = [
            (r["name"], r["paper"], r["ours"], r["ceiling"], r["control"], r["note"] or None)
            for r in rows
            if r["table"] == title
        ]
        tables.append(Table(title, columns, cells))
    return tables


def format_paper_tables(rows: Sequence[Mapping]) -> str:
    """Return the rows as Markdown.

    Args:
        rows: Output of `compare_with_paper`.

    Returns:
        One Markdown table per table of the paper.
    """

    def show(value: float | None) -> str:
        return "-" if value is None else f"{value:.4g}"

    lines = []
    for title in dict.fromkeys(row["table"] for row in rows):
        lines += ["", f"## {title}", "", "| score | paper | here | ceiling | control | remark |", "|---" * 6 + "|"]
        for row in (r for r in rows if r["table"] == title):
            numbers = " | ".join(show(row[name]) for name in ("paper", "ours", "ceiling", "control"))
            lines.append(f"| {row['name']} | {numbers} | {row['note']} |")
    return "\n".join(lines[1:]) + "\n"
