#!/usr/bin/env python3
"""Score generated scenes against real ones, and an LVAE's reconstructions against the truth, from the tables alone.

    jobs/evaluate_scenes.py --real DIR --generated DIR
    jobs/evaluate_scenes.py --real DIR --generated DIR --inception weights-inception-2015-12-05-6726825d.pth
    jobs/evaluate_scenes.py --real DIR --generated DIR --samples 10000 --k 3 5 --reference apart --apart-m 10
    jobs/evaluate_scenes.py --real DIR --generated samples.npz --inception FILE
    jobs/evaluate_scenes.py --real DIR --lvae MODEL

By default as in the paper: at most 1,000 training scenes with poses as far apart as can be, as many generated ones with
labels in equal parts, k = 3. Every score comes with a 95 % interval over scenes.

Writes metrics.json, metrics.parquet and evaluation.html; with --lvae also reconstruction.html, with the best and worst
scenes, and reconstruction.parquet, a row per scene; all of it goes to MLflow too. FID, sFID, KID, IS, precision and
recall need local Inception weights; without them distances of layout statistics and of a fixed random network are given,
under their own names. Run it again with the same options to go on after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from jobs.support.cli import absolute, home, run, start_ray

if TYPE_CHECKING:
    from rich.progress import Progress

    from pipelines.evaluation.features import Looks, Side
    from pipelines.schema.dataset import Dataset


@dataclass(frozen=True)
class Config:
    real: str = ""
    """Dataset directory of the real scenes (default: $PRITTI_HOME/datasets/town), or an .npz of pictures, as ADM's."""
    real_split: str = "train"
    """Split that generated scenes are compared with; the paper takes the training split."""
    generated: str = ""
    """Dataset directory of the generated scenes (default: $PRITTI_HOME/generated, and with --lvae none unless --run names
    one), or an .npz of pictures, as ADM's; of those, the first --samples."""
    generated_split: str = ""
    """Only this split of them (default: whatever is there); --generated may be any dataset directory."""
    run: str = ""
    """Only source generated-<run> (default: whatever is there)."""
    generated_source: str = ""
    """Only this source, such as edited-<run> or imported-<name> (default: whatever is there)."""
    samples: int = 1000
    """At most so many scenes on each side, equally many; the paper takes 1000, also 5000 and 10000."""
    reference: Literal["farthest", "apart", "spread"] = "farthest"
    """Which real scenes: poses as far apart as can be, all poses at least --apart-m apart, or evenly spread ones."""
    apart_m: float = 10.0
    """Distance of poses for --reference apart."""
    balance: bool = True
    """Take equally many generated scenes of each label, as far as they go."""
    k: tuple[int, ...] = (3,)
    """Neighbourhood sizes of precision, recall, density and coverage."""
    supersample: int = 1
    """Draw each pixel of a picture as the mean of so many squared."""
    inception: str = ""
    """Local Inception weights (pt_inception-2015-12-05) for FID, sFID, KID, IS, precision and recall."""
    lvae: str = ""
    """Also score this LVAE's reconstruction of real scenes."""
    lvae_split: str = "test"
    """Split to reconstruct."""
    limit: int | None = None
    """With --lvae: reconstruct at most so many scenes, spread evenly."""
    voxel_range_m: tuple[float, float] = (-1.5, 6.5)
    """Lowest and highest z of the 256 x 256 x 32 voxels."""
    pictures: int = 3
    """So many of the best and of the worst reconstructed scenes to show."""
    output: str = ""
    """Where everything goes (default: $PRITTI_HOME/evaluations/<run or 'latest'>)."""
    actors: int = 2


def evaluate(config: Config) -> dict:
    """Score, write and return the nested metrics, as metrics.json holds them."""
    from rich.progress import Progress

    from jobs.support.tracking import publish_scores
    from pipelines.schema.dataset import Dataset

    for name, least in (("pictures", 0), ("samples", 2), ("supersample", 1)):
        if (given := getattr(config, name)) < least:
            raise ValueError(f"--{name} is {given}, expected {least} or more")
    if config.limit is not None and not config.lvae:
        raise ValueError("--limit counts scenes to reconstruct, with --lvae; of generated scenes --samples")
    dataset = None
    if config.lvae or not config.real.endswith(".npz"):
        dataset = Dataset.open(absolute(config.real) if config.real else home("datasets", "town"))
    named = config.run or config.generated_source or not config.lvae
    wanted = config.generated or (home("generated") if named else "")
    output = absolute(config.output) if config.output else home("evaluations", config.run or "latest")
    from pipelines.runtime import storage

    if config.inception and not storage.exists(absolute(config.inception)):
        raise ValueError(f"--inception {config.inception}: no such file; docs/evaluation.md says where to get it")
    if config.lvae and not storage.exists(storage.join(absolute(config.lvae), "config.json")):
        raise ValueError(f"--lvae {config.lvae}: no layout VAE here; run jobs/train_lvae.py first")
    scores: dict = {}
    sides = chosen_sides(config, dataset) if wanted else {}
    start_ray()
    with Progress() as bar:
        if config.lvae:
            scores["reconstruction"] = reconstruction(config, dataset, output, bar)
        if wanted:
            scores["generation"] = generation(config, dataset, sides, output, bar)
    storage.write_json(scored(config, dataset, sides), storage.join(output, "evaluation.json"))
    tags = {
        "real": config.real or home("datasets", "town"),
        "split": config.real_split,
        "generated": wanted,
        "lvae": config.lvae and absolute(config.lvae),
    }
    pages = {"reconstruction": "reconstruction.html", "generation": "evaluation.html"}
    return publish_scores(output, scores, tags, [pages[name] for name in scores])


def scored(config: Config, dataset: Dataset | None, sides: dict[str, Side]) -> dict:
    """What scores are of: either side, how the generated one was sampled if one run made it all, the LVAE's weights."""
    from pipelines.runtime import storage
    from pipelines.schema.scene_subset import Selection
    from pipelines.training.latents import load_lvae, weights_digest

    about = {"real": dataset and dataset.root, "real_split": config.real_split, "source": None, "sampling": None}
    about["lvae_weights"] = weights_digest(load_lvae(absolute(config.lvae))) if config.lvae else None
    made = sides.get("generated")
    about["generated"] = made and made.root
    sources = {shard.source for shard, _ in made.shards()} if isinstance(made, Selection) else ()
    if len(sources) == 1:
        about["source"] = sources.pop()
        record = storage.join(made.root, f"{about['source']}.json")
        about["sampling"] = storage.read_json(record) if storage.exists(record) else None
    return about


def generation(config: Config, dataset: Dataset | None, sides: dict[str, Side], output: str, bar: Progress) -> dict:
    """Scores of the generated scenes; writes evaluation.html and what is known of each scene, under described/."""
    from pipelines.evaluation.evaluate import compare, memorisation, plain
    from pipelines.evaluation.example_images import pictures_shown
    from pipelines.evaluation.features import Looks, PictureFile, describe
    from pipelines.metrics.adm_npz import reference_moments
    from pipelines.reporting.evaluation_report import evaluation_html
    from pipelines.runtime import storage

    looks = Looks(config.supersample, config.inception and absolute(config.inception))
    described = {}
    for name, side in sides.items():
        task, directory = bar.add_task(f"describe {name}", total=side.limit), storage.join(output, "described", name)
        described[name] = describe(
            side, dataset, looks, directory, config.actors, lambda n, task=task: bar.advance(task, n)
        )
    task = bar.add_task("compare", total=2)
    reference = reference_moments(sides["real"].path) if isinstance(sides["real"], PictureFile) else None
    classes = dataset.spec.ground_classes if dataset else ()
    scores = compare(described["real"], described["generated"], classes, config.k, reference)
    bar.advance(task)
    features = "pool3" if "pool3" in described["real"] else "random"
    found = memorisation(described["real"][features], described["generated"][features])
    scores["memorisation"] = found | {"features": {"pool3": "Inception pool3", "random": "untrained"}[features]}
    bar.advance(task)
    counts = {name: part["statistics"][:, :11] for name, part in described.items() if "statistics" in part}
    shown = pictures_shown(sides["real"], sides["generated"], described["generated"], scores["memorisation"])
    html = evaluation_html(plain(scores), counts, shown, protocol(config, sides, looks))
    storage.write_text(html, storage.join(output, "evaluation.html"))
    return scores


def chosen_sides(config: Config, dataset: Dataset | None) -> dict[str, Side]:
    """Both sides, of equal number. Raises ValueError for pictures of unequal size."""
    from dataclasses import replace

    from pipelines.evaluation.features import PictureFile
    from pipelines.metrics.adm_npz import picture_shape
    from pipelines.schema.scene_subset import Selection

    source = config.generated_source or (f"generated-{config.run}" if config.run else None)
    generated = absolute(config.generated) if config.generated else home("generated")
    labels = "balanced" if config.balance else "spread"
    sides, counts, sizes = {}, {}, {}
    for name, path in (("real", absolute(config.real) if config.real else ""), ("generated", generated)):
        if path.endswith(".npz"):
            count, *sizes[name], _ = picture_shape(path)
            counts[name], sides[name] = min(count, config.samples), PictureFile(path, count)
            continue
        if name == "real":
            side = Selection(
                dataset.root, dataset.source, config.real_split, config.samples, config.reference, config.apart_m
            )
        else:
            side = Selection(path, source, config.generated_split or None, config.samples, labels)
        sizes[name], sides[name] = [256, 256], side
        counts[name] = sum(len(rows) for _, rows in side.shards())
    if sizes["real"] != sizes["generated"]:
        raise ValueError(
            f"real pictures are {sizes['real']} pixels, generated ones {sizes['generated']}: make them alike"
        )
    return {name: replace(side, limit=min(counts.values())) for name, side in sides.items()}


def protocol(config: Config, sides: dict[str, Side], looks: Looks) -> list[str]:
    """How it was done, in words."""
    from pipelines.evaluation.features import PictureFile
    from pipelines.metrics.inception import weights_line

    how = {
        "farthest": "poses as far apart as can be (farthest point sampling)",
        "apart": f"poses at least {config.apart_m:g} m apart",
        "spread": "evenly spread",
    }[config.reference]
    chosen = {
        "real": f"split {config.real_split}, {how}",
        "generated": "labels in equal parts as far as they go" if config.balance else "evenly spread",
    }
    words = [
        f"{name.capitalize()}: {side.limit} of {side.root}, {'the first' if isinstance(side, PictureFile) else chosen[name]}."
        for name, side in sides.items()
    ]
    drawn = "" if config.supersample == 1 else f", each pixel the mean of {config.supersample**2}"
    words.append(f"Pictures of scenes: 256 x 256 pixels from above in class colours, unlit, on white{drawn}.")
    return [*words, weights_line(looks.inception)] if looks.inception else words


def reconstruction(config: Config, dataset: Dataset, output: str, bar: Progress) -> dict:
    """Scores; writes reconstruction.parquet, a row per scene, and reconstruction.html with the best and worst of them."""
    from pipelines.evaluation.reconstruction import draw, rebuild
    from pipelines.reporting.reconstruction_report import reconstruction_html
    from pipelines.runtime import storage
    from pipelines.schema.scene_subset import Selection

    real = Selection(dataset.root, dataset.source, config.lvae_split, config.limit)
    lvae = absolute(config.lvae)
    shown = bar.add_task("reconstruct", total=sum(len(rows) for _, rows in real.shards()))
    rebuilt = rebuild(
        real,
        lvae,
        config.actors,
        voxel_range_m=config.voxel_range_m,
        dataset=dataset,
        on_scene=lambda: bar.advance(shown),
    )
    storage.write_parquet(rebuilt.scenes, storage.join(output, "reconstruction.parquet"))
    count = min(config.pictures, len(rebuilt.places) // 2)
    drawn = []
    if count:
        chosen = rebuilt.places[:count] + rebuilt.places[-count:]
        drawing = bar.add_task("draw best and worst", total=len(chosen))
        drawn = draw(chosen, lvae, config.actors, lambda: bar.advance(drawing))
    subtitle = f"{lvae} on {rebuilt.scores['scenes']} scenes of {real.root}, split {real.split}"
    html = reconstruction_html(rebuilt.scores, rebuilt.scenes, drawn[:count], drawn[count:][::-1], subtitle)
    storage.write_text(html, storage.join(output, "reconstruction.html"))
    return rebuilt.scores


def main(config: Config) -> None:
    from rich.console import Console
    from rich.table import Table

    from pipelines.reporting.evaluation_report import headlines, written

    lines = Table("metric", "value")
    for name, value in headlines(evaluate(config)):
        lines.add_row(name, written(value))
    Console().print(lines)


if __name__ == "__main__":
    run(main, Config, description=__doc__)
