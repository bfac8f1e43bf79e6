"""Implementation of jobs/evaluate_scenes.py."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from rich.console import Console
from rich.table import Table

from jobs.evaluate_scenes import Config
from jobs.implementation.checks import check_evaluate_scenes
from jobs.implementation.protocols import PROTOCOLS, Protocol, apply_protocol
from jobs.support.cli import home_path, make_absolute, resolve_path
from jobs.support.lite0 import prepare_lite0
from jobs.support.outputs import hold_output
from jobs.support.progress import JobProgress
from jobs.support.scores import publish_scores
from jobs.support.value_names import REFERENCES
from models.pretrained import INDEX_NAME
from models.scene import Scene
from models.tensors import EXISTENCE_THRESHOLD
from models.uris import split_name
from pipelines.evaluation.evaluate import (
    compare_datasets,
    convert_estimates,
    find_sensitive_scores,
    rate_validity,
    score_nearest_distances,
    score_sets,
)
from pipelines.evaluation.example_images import select_even_images, select_shown_images
from pipelines.evaluation.features import (
    FeatureConfig,
    FeatureParts,
    ImageFile,
    SceneSet,
    StoredFeatures,
    compute_scene_features,
    count_scenes,
    drop_blank,
)
from pipelines.evaluation.reconstruction import draw_scenes, evaluate_reconstruction, score_ceiling_and_control
from pipelines.evaluation.streamed import compare_streamed
from pipelines.metrics.adm_npz import read_picture_shape, read_reference_moments
from pipelines.metrics.controls import CONTROLS
from pipelines.metrics.inception import describe_weights
from pipelines.metrics.inception_score import compute_streamed_inception_score
from pipelines.metrics.lite0 import describe_lite0
from pipelines.metrics.vgg16 import describe_vgg16
from pipelines.reporting.evaluation_report import ExamplePictures, format_value, list_headlines, render_evaluation_html
from pipelines.reporting.guess_page import render_guess_html
from pipelines.reporting.reconstruction_report import render_reconstruction_html, select_overall_scores
from pipelines.runtime import storage
from pipelines.schema.dataset import Dataset
from pipelines.schema.scene_subset import Pick, SceneSubset
from pipelines.training.latents import digest_weights, load_lvae

HALVES = {"real": "first", "ceiling": "second"}


def evaluate(config: Config) -> dict:
    """Evaluate, write all files, and return the nested metrics of metrics.json."""
    check_evaluate_scenes(config)
    config = apply_protocol(config)
    dataset: Dataset | None = None
    if config.lvae or not config.real.endswith(".npz"):
        dataset = Dataset.open(resolve_path(config.real, "datasets", "town"))
    named = config.run or config.generated_source or not config.lvae
    wanted = config.generated or (home_path("generated") if named else "")
    output = resolve_path(config.output, "evaluations", config.run or "latest")
    scores: dict = {}
    sides = select_sides(config, dataset) if wanted else {}
    with hold_output(output, "evaluation", config):
        with JobProgress() as bar:
            if config.lvae and dataset is not None:
                scores["reconstruction"] = score_reconstruction(config, dataset, output, bar)
            if wanted:
                is_streamed = bool(config.protocol) and PROTOCOLS[config.protocol].is_streamed
                evaluate_sides = evaluate_streamed if is_streamed else evaluate_generation
                scores["generation"] = evaluate_sides(config, dataset, sides, output, bar)
        storage.write_json(describe_inputs(config, dataset, sides), storage.join_uri(output, "evaluation.json"))
        tags = {
            "real": config.real or home_path("datasets", "town"),
            "split": config.real_split,
            "protocol": config.protocol,
            "generated": wanted,
            "lvae": config.lvae and make_absolute(config.lvae),
        }
        pages = {"reconstruction": "reconstruction.html", "generation": "evaluation.html"}
        return publish_scores(output, scores, tags, [pages[name] for name in scores])


def describe_inputs(config: Config, dataset: Dataset | None, sides: dict[str, SceneSet]) -> dict:
    """Return a description of the evaluated scenes and of the weights of the layout VAE.

    The description includes the sampling options if one run generated all scenes.
    """
    about = {"real": dataset and dataset.root, "real_split": config.real_split, "source": None, "sampling": None}
    about["lvae_weights"] = digest_weights(load_lvae(make_absolute(config.lvae))) if config.lvae else None
    made = sides.get("generated")
    about["generated"] = made and made.root
    sources = {shard.source for shard, _ in made.shards()} if isinstance(made, SceneSubset) else ()
    if made is not None and len(sources) == 1:
        about["source"] = sources.pop()
        record = storage.join_uri(made.root, f"{about['source']}.json")
        about["sampling"] = storage.read_json(record) if storage.exists(record) else None
    return about


def evaluate_generation(
    config: Config, dataset: Dataset | None, sides: dict[str, SceneSet], output: str, bar: JobProgress
) -> dict:
    """Score generated scenes, write evaluation.html, and write the features of each scene to described/."""
    protocol = PROTOCOLS[config.protocol] if config.protocol else Protocol("")
    drops_blank, only_nearest = protocol.drops_blank, protocol.only_nearest
    looks = FeatureConfig(
        config.supersample,
        config.inception and make_absolute(config.inception),
        "" if only_nearest else prepare_lite0(config.lite0),
        vgg16=config.vgg16 and make_absolute(config.vgg16),
        random=not only_nearest,
        blank=drops_blank,
    )
    described: dict[str, StoredFeatures] = {}
    dropped: dict[str, int] = {}

    def describe(name: str, side: SceneSet, how: FeatureConfig) -> None:
        task = bar.add_task(f"describe {name}", total=side.limit)
        directory = storage.join_uri(output, "described", name)
        described[name] = compute_scene_features(
            side, None if only_nearest else dataset, how, directory, config.num_actors, lambda n: bar.advance(task, n)
        ).open()
        if drops_blank:
            described[name], dropped[name] = drop_blank(described[name])
            if (left := len(described[name]["scene_id"])) < 2:
                raise ValueError(
                    f"--protocol {config.protocol} drops {dropped[name]} of {dropped[name] + left} pictures of"
                    f" {side.root} ({name}), because they are white or contain a black pixel; at least 2 are needed"
                )

    for name, side in sides.items():
        describe(name, side, looks)
    if config.controls and "ceiling" in sides:
        for name in CONTROLS:
            describe(name, sides["ceiling"], replace(looks, control=name))
    classes = dataset.spec.ground_classes if dataset else ()
    others = {name: part for name, part in described.items() if name == "ceiling" or name in CONTROLS}
    task = bar.add_task("compare", total=3)
    reference = read_reference_moments(sides["real"].path) if isinstance(sides["real"], ImageFile) else None
    if only_nearest:
        scores: dict = {"scenes": {name: count_scenes(sides[name]) for name in ("real", "generated")}}
    else:
        scores = compare_datasets(described["real"], described["generated"], classes, config.k, reference)
    bar.advance(task)
    if others:
        scores["sets"] = score_sets(described["real"], others, classes, config.k)
        if config.controls:
            scores["sensitive"] = find_sensitive_scores(scores["sets"])
    bar.advance(task)
    nearest_name, nearest = score_nearest_distances(described["real"], described["generated"])
    scores[nearest_name] = nearest
    bar.advance(task)
    peers = describe_peers(config, dataset, output, bar)
    if peers:
        scores["peers"] = {name: rate_validity(part) for name, part in peers.items()}
    counts = {
        name: described[name]["statistics"][:, :11] for name in ("real", "generated") if "statistics" in described[name]
    }
    shown = select_shown_images(sides["real"], sides["generated"], described, nearest)
    scores["protocol"] = config.protocol or None
    words = describe_protocol(config, sides, looks)
    if drops_blank:
        scores["dropped"] = {name: dropped[name] for name in sides}
        numbers = ", ".join(f"{dropped[name]} of {sides[name].limit} ({name})" for name in sides)
        words.append(f"Dropped pictures (entirely white, or any pixel of pure black): {numbers}.")
    html = render_evaluation_html(convert_estimates(scores), counts, shown, words)
    storage.write_text(html, storage.join_uri(output, "evaluation.html"))
    if config.guess_scenes:
        write_guess_page(sides, config.guess_scenes, storage.join_uri(output, "guess.html"), bar)
    return scores


def write_guess_page(sides: dict[str, SceneSet], count: int, path: str, bar: JobProgress) -> None:
    """Write a page with `count` evenly spread real scenes and as many generated scenes in random order."""

    def read(side: SceneSet) -> list[Scene]:
        selected = replace(cast(SceneSubset, side), limit=min(count, count_scenes(side)), pick="spread")
        return [scene for shard, rows in selected.shards() for scene in shard.scenes(rows)]

    real, generated = read(sides["real"]), read(sides["generated"])
    task = bar.add_task("draw guess.html", total=len(real) + len(generated))
    html = render_guess_html(real, generated, "Real or generated?", on_scene=lambda: bar.advance(task))
    storage.write_text(html, path)


def evaluate_streamed(
    config: Config, dataset: Dataset | None, sides: dict[str, SceneSet], output: str, bar: JobProgress
) -> dict:
    """Compute Frechet distances and the Inception score part by part, and write evaluation.html.

    The dataset is not passed to the features, so only features of pictures are computed.
    """
    inception = config.inception and make_absolute(config.inception)
    looks = FeatureConfig(
        config.supersample, inception, "" if inception else prepare_lite0(config.lite0), random=not inception
    )
    wanted = [(name, name, looks) for name in sides]
    if config.controls:
        wanted += [(name, "ceiling", replace(looks, control=name)) for name in CONTROLS]
    parts: dict[str, FeatureParts] = {}
    for name, side, how in wanted:
        task = bar.add_task(f"describe {name}", total=sides[side].limit)
        directory = storage.join_uri(output, "described", name)
        parts[name] = compute_scene_features(
            sides[side], None, how, directory, config.num_actors, lambda n, task=task: bar.advance(task, n)
        )
    task = bar.add_task("compare", total=1)
    found = compare_streamed(parts["real"], {name: part for name, part in parts.items() if name != "real"})
    bar.advance(task)
    counts = {name: count_scenes(sides[name]) for name in ("real", "generated")}
    scores: dict = {"scenes": counts, "protocol": config.protocol} | found.pop("generated")
    if inception:
        scores["inception_score_real"] = compute_streamed_inception_score(parts["real"].iterate_column("logits"))
    if found:
        scores["sets"] = found
    if config.controls:
        scores["sensitive"] = find_sensitive_scores(found)
    real, generated = (select_even_images(sides[name], counts[name]) for name in ("real", "generated"))
    words = describe_protocol(config, sides, looks)
    html = render_evaluation_html(convert_estimates(scores), {}, ExamplePictures(real, generated), words)
    storage.write_text(html, storage.join_uri(output, "evaluation.html"))
    return scores


def describe_peers(config: Config, dataset: Dataset | None, output: str, bar: JobProgress) -> dict:
    """Return the features of the scenes of other methods, by the last part of their directory's name."""
    if not config.peers or dataset is None:
        return {}
    found = {}
    for path in map(make_absolute, config.peers):
        side, name = SceneSubset(path), split_name(path)[1]
        side = replace(side, limit=sum(len(rows) for _, rows in side.shards()))
        task = bar.add_task(f"describe {name}", total=side.limit)
        found[name] = compute_scene_features(
            side,
            dataset,
            FeatureConfig(),
            storage.join_uri(output, "described", f"peer-{name}"),
            config.num_actors,
            lambda n, task=task: bar.advance(task, n),
        ).open()
    return found


def select_sides(config: Config, dataset: Dataset | None) -> dict[str, SceneSet]:
    """Return the same number of real, of generated and, for real scenes, of other real scenes (the ceiling).

    A protocol decides the numbers (`select_protocol_sides`).

    Raises:
        ValueError: Real and generated pictures differ in size, or the ceiling has no scenes.
    """
    protocol = PROTOCOLS[config.protocol] if config.protocol else None
    if protocol and dataset is not None and protocol.num_generated is None:
        num_generated = count_scenes(select_real(config, dataset, config.real_split))
    else:
        num_generated = protocol.num_generated if protocol else config.max_scenes
    source = config.generated_source or (f"generated-{config.run}" if config.run else None)
    generated = resolve_path(config.generated, "generated")
    labels: Pick = "balanced" if config.balance_labels else "spread"
    sides: dict[str, SceneSet] = {}
    sizes = {}
    for name, path in (("real", make_absolute(config.real) if config.real else ""), ("generated", generated)):
        if path.endswith(".npz"):
            count, *sizes[name], _ = read_picture_shape(path)
            sides[name] = ImageFile(path, min(count, num_generated or count))
        elif name == "real" and dataset is not None:
            sizes[name], sides[name] = [256, 256], select_real(config, dataset, config.real_split)
        else:
            side = SceneSubset(path, source, config.generated_split or None, num_generated or None, labels)
            sizes[name], sides[name] = [256, 256], side
    if sizes["real"] != sizes["generated"]:
        raise ValueError(
            f"real pictures have {sizes['real']} pixels, generated pictures have {sizes['generated']} pixels: "
            "expected the same size"
        )
    if protocol and dataset is not None:
        return select_protocol_sides(config, dataset, sides, num_generated or 0)
    if dataset is not None and isinstance(sides["real"], SceneSubset):
        sides |= select_ceiling(config, dataset, sides["real"], count_scenes(sides["generated"]))
    count = min(count_scenes(side) for side in sides.values())
    return {name: replace(side, limit=count) for name, side in sides.items()}


def select_protocol_sides(
    config: Config, dataset: Dataset, sides: dict[str, SceneSet], num_generated: int
) -> dict[str, SceneSet]:
    """Return the sides with the numbers of scenes of the protocol.

    The ceiling has as many scenes as the generated side. If the other split has fewer scenes, there is no ceiling.

    Raises:
        ValueError: A side has fewer scenes than the protocol needs, or --controls or --ceiling-split is given and there
            are too few other real scenes. The message names both numbers.
    """
    counts = {name: count_scenes(side) for name, side in sides.items()}
    needed = {"real": config.max_scenes or 1, "generated": num_generated}
    if PROTOCOLS[config.protocol].is_exact:
        for name, count in counts.items():
            if count < needed[name]:
                raise ValueError(
                    f"--protocol {config.protocol} needs {needed[name]} {name} scenes, but {sides[name].root} has"
                    f" {count}"
                )
    if PROTOCOLS[config.protocol].only_nearest:
        return {name: replace(side, limit=max(counts[name], 1)) for name, side in sides.items()}
    split = config.ceiling_split or "test"
    others = select_real(replace(config, max_scenes=counts["generated"] or None), dataset, split)
    if (count := count_scenes(others)) >= counts["generated"]:
        sides, counts = sides | {"ceiling": others}, counts | {"ceiling": count}
    elif config.controls or config.ceiling_split:
        option = "--controls" if config.controls else f"--ceiling-split {split}"
        raise ValueError(
            f"{option} with --protocol {config.protocol} needs {counts['generated']} other real scenes, but split"
            f" {split} of {dataset.root} has {count}"
        )
    # A side without scenes raises an error that names its directory when its shards are read.
    return {name: replace(side, limit=max(counts[name], 1)) for name, side in sides.items()}


def select_real(config: Config, dataset: Dataset, split: str, half: str = "") -> SceneSubset:
    """Return real scenes of a split, selected by the rule of --reference."""
    rule = REFERENCES[config.reference or "farthest-point"]
    return SceneSubset(dataset.root, dataset.source, split, config.max_scenes, rule, config.min_distance_m, half)


def select_ceiling(config: Config, dataset: Dataset, real: SceneSubset, wanted: int) -> dict[str, SceneSet]:
    """Return the reference scenes and the ceiling: scenes of another split, or two halves of one split.

    Raises:
        ValueError: --ceiling-split gives no scene.
    """
    halves = {name: select_real(config, dataset, config.real_split, half) for name, half in HALVES.items()}
    other = config.ceiling_split or ("test" if config.real_split == "train" else "train")
    splits = {"real": real, "ceiling": select_real(config, dataset, other)}
    ways = [halves] if other == "halves" else [splits] if config.ceiling_split else [splits, halves]
    counts = [min(wanted, *map(count_scenes, way.values())) for way in ways]
    best = counts.index(max(counts))
    if not counts[best]:
        raise ValueError(
            f"{dataset.root} has no real scenes for the ceiling (--ceiling-split {other}); name another split, or add"
            " scenes that lie at least 64 m from the others"
        )
    return dict(ways[best])


def describe_protocol(config: Config, sides: dict[str, SceneSet], looks: FeatureConfig) -> list[str]:
    """Return sentences that describe how the scenes were selected and drawn."""
    how = {
        "farthest-point": "farthest point sampling of poses",
        "min-distance": f"poses at least {config.min_distance_m:g} m apart",
        "uniform": "evenly spread" if config.max_scenes else "all scenes",
    }[config.reference or "farthest-point"]
    chosen = {
        "real": f"split {config.real_split}, {how}",
        "generated": "the same number of scenes per label, if there are enough scenes"
        if config.balance_labels
        else "evenly spread",
    }
    for name in ("real", "ceiling"):
        if isinstance(side := sides.get(name), SceneSubset):
            half = f", {side.half} half of the places" if side.half else ""
            chosen[name] = f"split {side.split}{half}, {how}"
    summary = PROTOCOLS[config.protocol].summary if config.protocol else "the options select scenes and scores"
    words = [f"Protocol: {config.protocol or 'none'} ({summary})."]
    words += [
        f"{name.capitalize()}: {side.limit} of {side.root}, "
        f"{'the first' if isinstance(side, ImageFile) else chosen[name]}."
        for name, side in sides.items()
    ]
    drawn = "" if config.supersample == 1 else f"; each pixel is the mean of {config.supersample**2} samples"
    words.append(
        f"Each picture shows a scene from above: 256 x 256 pixels, class colours, no shading, white background{drawn}."
    )
    if config.protocol and "ceiling" not in sides:
        words.append("There is no ceiling, because the other splits have fewer scenes than the generated side.")
    words += [describe_lite0()] if looks.lite0 else []
    words += [describe_vgg16(looks.vgg16)] if looks.vgg16 else []
    return [*words, describe_weights(looks.inception)] if looks.inception else words


def read_existence_threshold(lvae: str) -> float:
    """Return the existence threshold of the pipeline that a layout VAE belongs to.

    Args:
        lvae: Directory of the layout VAE; the directory above it may be a pipeline.

    Returns:
        Threshold of the pipeline. If there is no pipeline, or if it stores none: the paper's threshold.
    """
    index = storage.join_uri(split_name(lvae)[0], INDEX_NAME)
    stored = storage.read_json(index) if storage.exists(index) else {}
    return stored.get("existence_threshold", EXISTENCE_THRESHOLD)


def score_reconstruction(config: Config, dataset: Dataset, output: str, bar: JobProgress) -> dict:
    """Score reconstructions and write reconstruction.parquet and reconstruction.html.

    The page shows the scenes with the best and the worst reconstruction.
    """
    real = SceneSubset(dataset.root, dataset.source, config.lvae_split, config.max_reconstructed_scenes)
    lvae = make_absolute(config.lvae)
    shown = bar.add_task("reconstruct", total=sum(len(rows) for _, rows in real.shards()))
    rebuilt = evaluate_reconstruction(
        real,
        lvae,
        storage.join_uri(output, "reconstructed"),
        config.num_actors,
        voxel_range_m=config.voxel_range_m,
        dataset=dataset,
        on_scenes=lambda count: bar.advance(shown, count),
        label_threshold=read_existence_threshold(lvae),
    )
    task = bar.add_task("score ceiling and control", total=rebuilt.scores["scenes"])
    sets = score_ceiling_and_control(
        real,
        load_lvae(lvae).spec,
        storage.join_uri(output, "reconstruction_sets"),
        config.voxel_range_m,
        lambda count: bar.advance(task, count),
    )
    storage.write_json(sets, storage.join_uri(output, "reconstruction_sets.json"))
    scores = rebuilt.scores | {"sets": {name: select_overall_scores(found) for name, found in sets.items()}}
    storage.write_parquet(rebuilt.scenes, storage.join_uri(output, "reconstruction.parquet"))
    count = min(config.num_examples, len(rebuilt.places) // 2)
    drawn = []
    if count:
        chosen = rebuilt.places[:count] + rebuilt.places[-count:]
        drawing = bar.add_task("draw best and worst", total=len(chosen))
        drawn = draw_scenes(chosen, lvae, config.num_actors, lambda: bar.advance(drawing))
    subtitle = f"{lvae} on {scores['scenes']} scenes of {real.root}, split {real.split}"
    html = render_reconstruction_html(scores, rebuilt.scenes, drawn[:count], drawn[count:][::-1], subtitle)
    storage.write_text(html, storage.join_uri(output, "reconstruction.html"))
    return scores


def main(config: Config) -> None:
    lines = Table("metric", "value")
    for name, value in list_headlines(evaluate(config)):
        lines.add_row(name, format_value(value))
    Console().print(lines)
