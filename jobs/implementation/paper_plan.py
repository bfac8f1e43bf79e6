"""Plan of jobs/reproduce_paper.py: the stages with their options, command lines, times and disk space."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields
from typing import Any

from jobs.ablate_lvae import Branches
from jobs.encode_latents import Config as EncodeConfig
from jobs.evaluate_scenes import Config as EvaluateConfig
from jobs.implementation.preprocess_scenes import plan_shards
from jobs.preprocess_scenes import Av2 as Av2Drives
from jobs.preprocess_scenes import Kitti360 as Kitti360Drives
from jobs.reproduce_paper import Av2, Kitti360
from jobs.sample_scenes import Config as SampleConfig
from jobs.support.cli import home_path, make_absolute
from jobs.train_dit import Config as DiTConfig
from jobs.train_lvae import Config as LVAEConfig
from models.presets import DIT_PRESETS, LVAE_PRESETS
from pipelines.schema.splits import TEST, TRAIN

MINI_SCENES, MINI_LVAE_STEPS, MINI_DIT_STEPS = 96, 1000, 1000
PAPER_SCENES = 1000  # Scenes for precision and recall.
MIN_SCENES = 4  # Precision and recall compare each scene with three neighbours.
NEAREST_SCENES = 50_000  # Generated and training scenes of supplement G.
SWEEPS_PER_LOG = 156.5  # Argoverse 2: 313 sweeps in two logs.
# Measured by benchmarks/cost_rates.py: CPU time (s) and stored bytes per scene.
PREPROCESS_S, SCENE_BYTES, LATENT_BYTES, GENERATED_BYTES, FEATURE_BYTES = 0.0054, 14e3, 146e3, 21e3, 80e3
EVALUATE_S = 0.64
# Reported by the paper (supplement B.2 and B.3, Tab. 3): GPU hours on A100, and seconds per scene (GPU not stated).
PAPER_LVAE_GPU_H, PAPER_DIT_GPU_H, PAPER_SAMPLE_S = 72.0, 288.0, {"b": 0.58, "l": 1.78, "xl": 2.11}
ENCODE_GPU_S = 0.01  # Assumed.
# Measured on two cores by a rehearsal of KITTI-360 at 4e9d2b7: seconds per step and per scene. The layout VAE needed
# 2.2 s per step of batch 8; half of it is assumed for batch 4. The reconstruction needed 0.3 s per scene; ceiling and
# control add 0.23 s of CPU time at 09c6f74.
MINI_LVAE_STEP_S, MINI_DIT_STEP_S, MINI_ENCODE_S, RECONSTRUCT_S = 1.1, 0.33, 0.06, 0.5
MINI_SAMPLE_S = 3.8  # Seconds per scene with 250 denoising steps, by a rehearsal on one core at 4c3aadf.
MEASURED, REHEARSED = "rates of benchmarks/cost_rates.py, two cores", "a rehearsal on two cores"
REHEARSED_ON_ONE_CORE = "a rehearsal on one core"
BYTES_PER_WEIGHT, KEPT_CHECKPOINTS = 20, 2  # Weights, EMA, two moments of AdamW and the model, in float32.
WEIGHTS = {"lvae": 93.1e6, "b": 130e6, "l": 458e6, "xl": 675e6}
MINI_WEIGHTS = 4e6

PaperConfig = Kitti360 | Av2


@dataclass(frozen=True)
class Stage:
    """One stage of the plan.

    Attributes:
        name: Title.
        job: Name of the job that does the work.
        config: Options of the job.
        hours: Estimated duration (h).
        gigabytes: Estimated disk space of the results (GB).
        basis: Where the estimate comes from.
    """

    name: str
    job: str
    config: object
    hours: float
    gigabytes: float
    basis: str

    @property
    def command(self) -> str:
        """Equivalent command line."""
        return format_command(self.job, self.config)


@dataclass(frozen=True)
class Counts:
    """Number of scenes per split: of the dataset, or before preprocessing, of the poses.

    The poses of Argoverse 2 are estimated from the number of logs. Scenes without ground or with gaps are rejected.
    """

    train: int
    test: int


def find_source(config: PaperConfig) -> str:
    """Return the name of the dataset: kitti360 or av2."""
    return type(config).__name__.lower()


def make_drives_config(config: PaperConfig) -> Kitti360Drives | Av2Drives:
    """Return the options of preprocessing."""
    source = find_source(config)
    root, output = make_absolute(config.input), home_path("datasets", source)
    if isinstance(config, Kitti360):
        return Kitti360Drives(root, output, config.if_busy, slots="paper", skip_unreadable=config.skip_unreadable)
    return Av2Drives(root, output, config.if_busy, skip_unreadable=config.skip_unreadable)


def count_poses(config: PaperConfig) -> Counts:
    """Count the poses of KITTI-360 in its files of poses, or estimate those of Argoverse 2 from the number of logs.

    Raises:
        ValueError: A split has no poses, or the protocol needs more training poses or generated scenes.
    """
    counts = dict.fromkeys((TRAIN, TEST), 0.0)
    for task in plan_shards(make_drives_config(config)):
        if task.split in counts:
            counts[task.split] += sum(SWEEPS_PER_LOG if p.poses is None else len(p.poses) for p in task.parts)
    for split, count in counts.items():
        if not count:
            missing = "val/ with at least one log" if isinstance(config, Av2) and split == TEST else "longer drives"
            raise ValueError(
                f"{make_absolute(config.input)} has no {split} poses, but training and evaluation need both splits;"
                f" add {missing}"
            )
    found = Counts(round(counts[TRAIN]), round(counts[TEST]))
    check_counts(config, found)
    return found


def check_counts(config: PaperConfig, found: Counts) -> None:
    """Check that there are enough scenes for the protocols.

    Raises:
        ValueError: A protocol needs more training scenes or generated scenes.
    """
    limits = {"training": found.train, "test": found.test, "generated": count_scenes(config, found)}
    for side, count in limits.items():
        if config.scale == "mini" and count < MIN_SCENES:
            raise ValueError(f"there are {count} {side} scenes, but the evaluation needs at least {MIN_SCENES}")
    if config.scale == "paper" and found.train < PAPER_SCENES:
        raise ValueError(
            f"{make_absolute(config.input)} has {found.train} training scenes, but the paper's protocol compares"
            f" {PAPER_SCENES:,}; use --scale mini, or a larger part of the dataset"
        )
    if config.scale == "paper" and config.num_scenes and config.num_scenes < found.train:
        raise ValueError(
            f"--num-scenes is {config.num_scenes}, but the paper's protocol compares as many generated scenes as"
            f" training scenes; use at least {found.train}, or --scale mini"
        )


def make_plan(config: PaperConfig, counts: Counts) -> list[Stage]:
    """Return the stages in order.

    Args:
        config: Options of the job.
        counts: Number of poses per split.

    Returns:
        Stages with their estimates.
    """
    return list(_list_stages(config, counts))


def find_presets(config: PaperConfig, size: str) -> tuple[str, str]:
    """Return the names of the presets of the layout VAE and of a transformer."""
    source = find_source(config)
    if config.scale == "mini":
        return "kitti360-mini", "kitti360-mini"
    return source, source if size == "b" else f"{source}-{size}"


def count_scenes(config: PaperConfig, counts: Counts) -> int:
    """Return the number of scenes to generate per transformer."""
    wanted = MINI_SCENES if config.scale == "mini" else max(counts.train, PAPER_SCENES)
    return wanted if config.num_scenes is None else config.num_scenes


def _list_stages(config: PaperConfig, counts: Counts) -> Iterator[Stage]:
    source, mini, workers = find_source(config), config.scale == "mini", config.num_workers
    data, total = home_path("datasets", source), counts.train + counts.test
    names = ("gpus", "wait_for_resources_s", "if_busy")
    shared: dict[str, Any] = {name: getattr(config, name) for name in names}
    yield Stage(
        "preprocess the drives",
        "preprocess_scenes",
        make_drives_config(config),
        total * PREPROCESS_S / 2 / 3600,
        total * SCENE_BYTES / 1e9,
        MEASURED,
    )
    preset = find_presets(config, "b")[0]
    lvae = home_path("models", f"lvae-{preset}")
    chosen = config.lvae_steps or (MINI_LVAE_STEPS if mini else None)  # None: as in the preset
    steps = chosen or LVAE_PRESETS[preset].steps
    share = steps / LVAE_PRESETS[preset].steps
    weights = MINI_WEIGHTS if mini else WEIGHTS["lvae"]
    yield Stage(
        "train the layout VAE",
        "train_lvae",
        LVAEConfig(preset, data, num_workers=workers, steps=chosen, seed=config.seed, **shared),
        steps * MINI_LVAE_STEP_S / 3600 if mini else share * PAPER_LVAE_GPU_H / workers,
        weights * BYTES_PER_WEIGHT * KEPT_CHECKPOINTS / 1e9,
        REHEARSED if mini else f"the paper's {PAPER_LVAE_GPU_H:g} GPU hours on A100",
    )
    yield Stage(
        "encode latents",
        "encode_latents",
        EncodeConfig(dataset=data, lvae=lvae, num_actors=workers, **shared),
        total * (MINI_ENCODE_S if mini else ENCODE_GPU_S) / workers / 3600,
        total * LATENT_BYTES / 1e9,
        REHEARSED if mini else "assumed",
    )
    yield Stage(
        "evaluate the reconstruction",
        "evaluate_scenes",
        EvaluateConfig(
            real=data,
            lvae=lvae,
            output=home_path("evaluations", "reconstruction"),
            num_actors=workers,
            **shared,
        ),
        counts.test * RECONSTRUCT_S / 3600,
        counts.test * 1e4 / 1e9,
        REHEARSED if mini else f"{REHEARSED}, with a smaller network",
    )
    if config.ablations:
        variants = ("without latent split", "without objects", "without ground")
        yield Stage(
            "train the ablations of the layout VAE",
            "ablate_lvae",
            Branches(preset, data, steps=steps, num_seeds=1, only_variants=variants, num_workers=workers, **shared),
            3 * (steps * MINI_LVAE_STEP_S / 3600 if mini else share * PAPER_LVAE_GPU_H / workers),
            3 * weights * BYTES_PER_WEIGHT * KEPT_CHECKPOINTS / 1e9,
            REHEARSED if mini else f"the paper's {PAPER_LVAE_GPU_H:g} GPU hours on A100 per variant",
        )
    for size in config.transformers:
        yield from _list_transformer_stages(config, counts, size, data, shared)


def _list_transformer_stages(
    config: PaperConfig, counts: Counts, size: str, data: str, shared: dict
) -> Iterator[Stage]:
    mini, workers = config.scale == "mini", config.num_workers
    preset, scenes, title = find_presets(config, size)[1], count_scenes(config, counts), f"DiT-{size.upper()}"
    full = DIT_PRESETS[preset].steps
    chosen = config.dit_steps or (MINI_DIT_STEPS if mini else None)
    steps = chosen or full
    weights = MINI_WEIGHTS if mini else WEIGHTS[size]
    model = home_path("models", f"pritti-{size}")
    yield Stage(
        f"train {title}",
        "train_dit",
        DiTConfig(
            preset,
            data,
            name=f"dit-{size}",
            output=model,
            num_workers=workers,
            steps=chosen,
            seed=config.seed,
            **shared,
        ),
        steps * MINI_DIT_STEP_S / 3600 if mini else steps / full * PAPER_DIT_GPU_H / workers,
        weights * BYTES_PER_WEIGHT * KEPT_CHECKPOINTS / 1e9,
        REHEARSED if mini else f"the paper's {PAPER_DIT_GPU_H:g} GPU hours on A100",
    )
    per_scene = MINI_SAMPLE_S if mini else PAPER_SAMPLE_S[size]
    yield Stage(
        f"sample scenes of {title}",
        "sample_scenes",
        SampleConfig(
            model=model,
            output=home_path("generated"),
            run=size,
            num_scenes=scenes,
            seed=config.seed,
            num_inference_steps=config.num_inference_steps,
            num_actors=workers,
            **shared,
        ),
        scenes * per_scene * config.num_inference_steps / 250 / workers / 3600,
        scenes * GENERATED_BYTES / 1e9,
        REHEARSED_ON_ONE_CORE if mini else f"the paper's {per_scene:g} s per scene",
    )
    common: dict[str, Any] = {"real": data, "generated": home_path("generated"), "run": size}
    common |= {"inception": config.inception, "num_actors": workers, **shared}
    hours = 2 * EVALUATE_S * min(scenes, PAPER_SCENES) / 2 / 3600
    limits: dict[str, Any] = {"max_scenes": min(scenes, counts.train)} if mini else {"protocol": "paper-pr"}
    yield Stage(
        f"evaluate the scenes of {title}",
        "evaluate_scenes",
        EvaluateConfig(
            controls=mini or counts.test >= PAPER_SCENES,
            vgg16=config.vgg16 if mini else "",
            output=home_path("evaluations", f"{size}-precision"),
            **limits,
            **common,
        ),
        10 * hours if mini or counts.test >= PAPER_SCENES else hours,
        10 * 2 * min(scenes, PAPER_SCENES) * FEATURE_BYTES / 1e9,
        MEASURED,
    )
    if not mini:
        yield Stage(
            f"compute FID of {title} over all scenes",
            "evaluate_scenes",
            EvaluateConfig(protocol="paper-fid", output=home_path("evaluations", f"{size}-fid"), **common),
            2 * EVALUATE_S * scenes / 2 / 3600,
            2 * scenes * FEATURE_BYTES / 1e9,
            MEASURED,
        )
    # The paper reports these distances for one transformer on KITTI-360.
    if config.vgg16 and not mini and size == "b" and isinstance(config, Kitti360):
        count = min(scenes, NEAREST_SCENES)
        nearest: dict[str, Any] = common | {"inception": ""}
        yield Stage(
            f"find the nearest training scenes of {title}",
            "evaluate_scenes",
            EvaluateConfig(
                protocol="paper-nearest",
                vgg16=config.vgg16,
                output=home_path("evaluations", f"{size}-nearest"),
                **nearest,
            ),
            2 * EVALUATE_S * count / 2 / 3600,
            2 * count * FEATURE_BYTES / 1e9,
            MEASURED,
        )


def format_command(job: str, config: object) -> str:
    """Return the command line of a job with the given options; options with their default value are left out.

    Args:
        job: Name of the job.
        config: Options.

    Returns:
        The command, quoted for a shell.
    """
    words = [f"jobs/{job}.py"]
    if job in ("preprocess_scenes", "ablate_lvae"):
        words.append(type(config).__name__.lower())
    for field in fields(config):  # pyright: ignore[reportArgumentType]
        value = getattr(config, field.name)
        default = field.default if field.default is not MISSING else None
        if value == default:
            continue
        option = "--wait-for-resources" if field.name == "wait_for_resources_s" else f"--{field.name.replace('_', '-')}"
        if field.name == "preset":
            words.append(str(value))
        elif isinstance(value, bool):
            words.append(option if value else option.replace("--", "--no-", 1))
        elif isinstance(value, tuple):
            words += [option, *map(str, value)]
        else:
            words += [option, f"{value:g}" if isinstance(value, float) else str(value)]
    return shlex.join(words)
