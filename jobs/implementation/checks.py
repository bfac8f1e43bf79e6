"""Checks of options that need neither torch nor Ray.

`run` reports invalid options before it imports a job's implementation. A function check_<job>(config) raises ValueError
for an invalid option. The implementations also call these functions.
"""

from __future__ import annotations

from collections.abc import Sequence

from jobs.encode_latents import Config as EncodeConfig
from jobs.evaluate_scenes import Config as EvaluateConfig
from jobs.furnish_place import Config as FurnishConfig
from jobs.implementation.protocols import PROTOCOLS, apply_protocol
from jobs.inpaint_scenes import Config as InpaintConfig
from jobs.outpaint_scenes import Config as OutpaintConfig
from jobs.preprocess_scenes import Av2, Kitti360, OpenDrive, Osm, Own, Py123d, Town
from jobs.publish_model import Config as PublishConfig
from jobs.sample_scenes import Config as SampleConfig
from jobs.simulate_traffic import Config as TrafficConfig
from jobs.support.cli import home_path, make_absolute, require_positive, resolve_path
from jobs.support.model_directories import find_pipeline_directory, require_model_labels
from jobs.train_dit import Config as DiTConfig
from jobs.train_lvae import Config as LVAEConfig
from jobs.train_street_planner import Config as StreetPlannerConfig
from models.presets import DIT_PRESETS, LVAE_PRESETS, STREET_PLANNER_PRESETS, find_preset
from models.scene import CATEGORIES, VEGETATION, VEHICLES
from pipelines.runtime import storage
from pipelines.schema.dataset import Dataset
from pipelines.schema.mixture import Mixture

MAX_PLACE_M = 1024.0
MAX_TRAFFIC_S, MAX_ROAD_USERS = 3600.0, 2000
DENSITY_GROUPS = {"vegetation": VEGETATION, "vehicle": VEHICLES}  # Categories that each density label counts.


def find_training_dataset(config: LVAEConfig | DiTConfig, source: str) -> str:
    """Return the directory of --dataset, or of the preset's dataset if the option is empty."""
    if config.dataset:
        return make_absolute(config.dataset)
    return home_path("datasets", "smoke" if config.preset == "smoke" else source)


def open_mixture(config: LVAEConfig | DiTConfig, source: str) -> Mixture:
    """Open --dataset, or the dataset of the preset, and --add-datasets."""
    added = [make_absolute(root) for root in config.add_datasets]
    return Mixture.open([find_training_dataset(config, source), *added], config.dataset_weights)


def require_datasets(roots: Sequence[str]) -> None:
    """Raise an error if a directory is no dataset. The smoke preset checks this before it generates its own dataset."""
    for root in roots:
        Dataset.open(make_absolute(root))


def needs_smoke_inputs(config: LVAEConfig | DiTConfig) -> bool:
    """Return whether a training run generates its own missing inputs."""
    return config.preset == "smoke" and not config.dataset


def check_train_lvae(config: LVAEConfig) -> None:
    row = find_preset(LVAE_PRESETS, config.preset)
    require_positive(config, "gradient_accumulation_steps")
    if config.start_from and config.train_object_decoder_of:
        raise ValueError("--start-from and --train-object-decoder-of exclude each other: give one of them")
    if config.round_weights and config.train_object_decoder_of:
        raise ValueError(
            "--round-weights would change the encoders that --train-object-decoder-of keeps; leave out one of them"
        )
    if config.start_from:
        find_start(config.start_from)
    if needs_smoke_inputs(config):
        require_datasets(config.add_datasets)
    else:
        open_mixture(config, row.source)


def find_start(model: str) -> tuple[str, bool]:
    """Return the directory of --start-from of train_lvae, and whether it holds a layout VAE and not a pipeline.

    Raises:
        ValueError: The directory holds neither.
    """
    directory = make_absolute(model)
    if storage.exists(storage.join_uri(directory, "config.json")):
        return directory, True
    try:
        return find_pipeline_directory(model), False
    except ValueError as error:
        raise ValueError(f"--start-from {error}; it also holds no layout VAE") from None


def check_train_dit(config: DiTConfig) -> None:
    row = find_preset(DIT_PRESETS, config.preset)
    require_positive(config, "gradient_accumulation_steps")
    if needs_smoke_inputs(config):
        require_datasets(config.add_datasets)
    else:
        mixture = open_mixture(config, LVAE_PRESETS[row.lvae].source)
        resolve_label_kind(config, mixture)
        find_latents(config, mixture)


def check_train_street_planner(config: StreetPlannerConfig) -> None:
    find_preset(STREET_PLANNER_PRESETS, config.preset)
    for model in filter(None, (config.model, config.start_from)):
        find_pipeline_directory(model)
    require_positive(config, "num_maps")


def resolve_label_kind(config: DiTConfig, mixture: Mixture) -> str:
    """Return --label-kind, or the default for the datasets.

    The paper conditions on vegetation density for KITTI-360 and on vehicle density for Argoverse 2, which has no
    vegetation.

    Raises:
        ValueError: A dataset has no object of a category that the label counts. All its scenes would get one label.
    """
    without = {
        name: [one.root for one in mixture.sampled if not {CATEGORIES[k] for k in group} & set(one.spec.categories)]
        for name, group in DENSITY_GROUPS.items()
    }
    lacks = {name for name, roots in without.items() if roots}
    kind = config.label_kind or ("vehicle" if "vegetation" in lacks else "vegetation")
    if missing := lacks & (set(DENSITY_GROUPS) if kind in ("joint", "partial") else {kind}):
        known = [name for name in (*DENSITY_GROUPS, "none") if name not in lacks]
        raise ValueError(
            f"--label-kind {kind}: {without[min(missing)][0]} has no objects of the group"
            f" {' or '.join(sorted(missing))}, so all its scenes would have the same label;"
            f" use --label-kind {' or '.join(known)}"
        )
    return kind


def find_latents(config: DiTConfig, mixture: Mixture) -> list[str]:
    """Return the directory of the latents of each dataset.

    Raises:
        ValueError: Latents are missing or incomplete, or come from different layout VAEs.
    """
    if config.add_latents and len(config.add_latents) != len(config.add_datasets):
        raise ValueError(
            f"--add-latents has {len(config.add_latents)} directories, expected one for each of the "
            f"{len(config.add_datasets)} of --add-datasets"
        )
    given = [config.latents, *(config.add_latents or [""] * len(config.add_datasets))]
    roots = [dataset.root for dataset in mixture.datasets]
    found = [make_absolute(one) if one else root for one, root in zip(given, roots, strict=True)]
    digests = []
    for latents, root in zip(found, roots, strict=True):
        require_latents(latents, root)
        content = storage.read_json(storage.join_uri(latents, "latents.json"))
        if (other := content["dataset"]) != root and other in roots:
            raise ValueError(
                f"{latents} holds latents of {other}, expected those of {root}; give --latents and --add-latents in the"
                " order of --dataset and --add-datasets"
            )
        digests.append(content["lvae_digest"])
        if digests[-1] != digests[0]:
            raise ValueError(
                f"{latents} holds latents of another layout VAE than {found[0]}; encode {root} with that layout VAE,"
                " and pass the directory with --add-latents"
            )
    return found


def require_latents(latents_root: str, dataset_root: str) -> None:
    """Check that a directory has complete latents.

    Raises:
        ValueError: There are no latents, or encoding was interrupted.
    """
    path = storage.join_uri(latents_root, "latents.json")
    if not storage.exists(path):
        raise ValueError(
            f"{latents_root}: no latents.json here; run jobs/encode_latents.py --dataset {dataset_root} --output"
            f" {latents_root} first, with --lvae MODEL"
        )
    if not storage.read_json(path)["complete"]:
        raise ValueError(
            f"{latents_root}: latents are incomplete; run jobs/encode_latents.py --dataset {dataset_root} --output"
            f" {latents_root} again, with the same --lvae"
        )


def check_encode_latents(config: EncodeConfig) -> None:
    Dataset.open(resolve_path(config.dataset, "datasets", "town"))


def check_preprocess_scenes(config: Town | Kitti360 | Av2 | Py123d | Osm | OpenDrive | Own) -> None:
    if isinstance(config, Town) and config.free_pose_share is not None:
        if not 0 <= config.free_pose_share <= 1:
            raise ValueError(f"--free-pose-share is {config.free_pose_share}, expected a share between 0 and 1")
        if config.free_pose_share and config.town_version == 1:
            raise ValueError(
                f"--free-pose-share is {config.free_pose_share}, but town version 1 has no free poses; "
                "add --town-version 2"
            )
    if isinstance(config, Osm | OpenDrive):
        check_map(config)
    elif not isinstance(config, Town) and not storage.exists(make_absolute(config.input)):
        raise ValueError(f"--input {config.input}: no such directory; specify the root directory of the dataset")


def check_map(config: Osm | OpenDrive) -> None:
    require_positive(config, "spacing_m")
    shares = {"test_share": 0.5}
    if isinstance(config, Osm):
        require_positive(config, "radius_m")
        if config.bbox is not None and config.origin is not None:
            raise ValueError("--bbox and --origin are both given; specify the region with one of them")
        shares["free_pose_share"] = 0.9
    for name, largest in shares.items():
        value = getattr(config, name)
        if not 0 <= value <= largest:
            raise ValueError(f"--{name.replace('_', '-')} is {value:g}, expected 0 to {largest:g}")


def check_furnish_place(config: FurnishConfig) -> None:
    if not storage.exists(make_absolute(config.input)):
        raise ValueError(f"--input {config.input}: no such file; pass an extract of OpenStreetMap or an OpenDRIVE file")
    require_positive(config, "size_m", "num_variants", "num_actors")
    if config.size_m > MAX_PLACE_M:
        raise ValueError(f"--size-m is {config.size_m:g}, expected at most {MAX_PLACE_M:g}; furnish several places")
    if len(config.origin) % 2:
        raise ValueError(f"--origin has {len(config.origin)} numbers, expected pairs such as 52.4737 13.4399")
    require_categories("keep_categories", config.keep_categories)
    require_model_labels(find_pipeline_directory(config.model), [config.label] if config.label else [])


def require_categories(name: str, categories: Sequence[str]) -> None:
    """Raise an error if an option names an unknown category."""
    if unknown := [category for category in categories if category not in CATEGORIES]:
        option = name.replace("_", "-")
        raise ValueError(f"--{option} {unknown[0]}, expected some of: {', '.join(CATEGORIES)}")


def check_sample_scenes(config: SampleConfig) -> None:
    require_positive(config, "num_scenes", "num_inference_steps", "num_actors", "batch_size", "decode_batch_size")
    require_model_labels(find_pipeline_directory(config.model), config.labels)


def check_simulate_traffic(config: TrafficConfig) -> None:
    require_positive(config, "duration_s", "vehicles_per_min")
    if config.pedestrians_per_min < 0 or config.num_examples < 0:
        raise ValueError("--pedestrians-per-min and --num-examples are 0 or more")
    if config.time_step_s < 0.25 or config.time_step_s % 0.25:
        raise ValueError(f"--time-step-s is {config.time_step_s:g}, expected a multiple of 0.25")
    rates = config.vehicles_per_min, config.pedestrians_per_min
    count = config.duration_s * sum(rates) / 60
    if not (config.duration_s <= MAX_TRAFFIC_S and all(rate >= 0 for rate in rates) and count <= MAX_ROAD_USERS):
        raise ValueError(
            f"--duration-s is {config.duration_s:g}, and the rates give {count:g} road users per scene; expected at"
            f" most {MAX_TRAFFIC_S:g} s and {MAX_ROAD_USERS} road users"
        )
    if config.seed < 0:
        raise ValueError(f"--seed is {config.seed}, expected 0 or more")


def check_publish_model(config: PublishConfig) -> None:
    find_pipeline_directory(config.model)


def check_inpaint_scenes(config: InpaintConfig) -> None:
    if not (config.polygon_m or config.half_plane or config.primitives):
        raise ValueError("no region; specify --polygon-m, --half-plane or --primitives")
    require_positive(config, "num_variants", "num_actors")
    if config.num_examples < 0:
        raise ValueError(f"--num-examples is {config.num_examples}, expected 0 or more")
    if config.polygon_m and (len(config.polygon_m) % 2 or len(config.polygon_m) < 6):
        raise ValueError(f"--polygon-m has {len(config.polygon_m)} numbers, expected x and y of at least three corners")
    require_categories("keep_categories", config.keep_categories)
    if config.keep_categories and config.contents == "ground":
        raise ValueError("--keep-categories has no effect with --contents ground, which keeps all objects; omit it")
    require_model_labels(find_pipeline_directory(config.model), [config.label] if config.label else [])


def check_outpaint_scenes(config: OutpaintConfig) -> None:
    require_positive(config, "num_actors", "batch_size")
    require_model_labels(find_pipeline_directory(config.model), [config.label] if config.label else [])


def check_evaluate_scenes(config: EvaluateConfig) -> None:
    apply_protocol(config)
    for name, least in (("num_examples", 0), ("max_scenes", 2), ("supersample", 1), ("guess_scenes", 0)):
        if (value := getattr(config, name)) is not None and value < least:
            raise ValueError(f"--{name.replace('_', '-')} is {value}, expected {least} or more")
    if config.guess_scenes:
        pictures = [path for path in (config.real, config.generated) if path.endswith(".npz")]
        if pictures:
            raise ValueError(f"--guess-scenes draws scenes, but {pictures[0]} contains pictures; omit the option")
        if config.protocol and PROTOCOLS[config.protocol].is_streamed:
            raise ValueError(f"--guess-scenes is not available with --protocol {config.protocol}; omit one of them")
        if config.lvae and not (config.generated or config.run or config.generated_source):
            raise ValueError("--guess-scenes needs generated scenes; add --generated, --run or --generated-source")
    if config.max_reconstructed_scenes is not None and not config.lvae:
        raise ValueError("--max-reconstructed-scenes needs --lvae; --max-scenes limits the generated scenes")
    if config.inception and not storage.exists(make_absolute(config.inception)):
        raise ValueError(
            f"--inception {config.inception}: no such file; docs/concepts/evaluation.md describes how to obtain it"
        )
    if config.vgg16 and not storage.exists(make_absolute(config.vgg16)):
        raise ValueError(
            f"--vgg16 {config.vgg16}: no such file; docs/concepts/evaluation.md describes how to obtain it"
        )
    if config.lvae and not storage.exists(storage.join_uri(make_absolute(config.lvae), "config.json")):
        raise ValueError(f"--lvae {config.lvae}: no layout VAE here; run jobs/train_lvae.py first")
