"""Fixtures shared by all tests."""

import importlib.util
import json
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

# Some virtual machines report AMX but do not support it. On these machines, oneDNN fails in bfloat16 with an illegal
# instruction.
os.environ.setdefault("ONEDNN_MAX_CPU_ISA", "AVX512_CORE_FP16")

from jaxtyping import install_import_hook

# These modules call short functions many times.
UNCHECKED = ("pipelines.preprocess.sources.town.land", "pipelines.preprocess.sources.triangulation")


def list_checked_modules() -> list[str]:
    """Return the modules of models and pipelines whose annotations are checked.

    The list excludes modules that import Ray, because Ray pickles their local functions. Checked functions cannot be
    pickled.
    """
    paths = [path for package in ("models", "pipelines") for path in sorted((ROOT / package).rglob("[!_]*.py"))]
    modules = [
        path
        for path in paths
        if not re.search(r"^\s*(import|from) (ray|pipelines.*ray_tasks)\b", path.read_text(), re.M)
    ]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in modules]
    return [name for name in names if name not in UNCHECKED]


# This process checks annotations of arguments, returns and dataclass fields, including shapes.
ROOT = Path(__file__).parents[1]
install_import_hook(list_checked_modules(), "typechecker.check_types")

import numpy as np
import pytest
from helpers import (
    REJECT_REASON,
    SHARD_SIZES,
    TOWN_SLOTS,
    fit_here,
    make_straight_drive,
    random_scene,
    small_spec,
    studio_scene,
    tiny_pipeline,
)

from models.layout import LayoutSpec
from models.scene import Scene
from pipelines.preprocess.sources.drive import Drive
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.runtime import storage
from pipelines.schema.conversion import make_rejects_table
from pipelines.schema.tables import Shard
from pipelines.traffic.dataset import make_tracks_table

MARKERS = {
    "unit": (),
    "integration": ("ray",),
    "faults": ("ray", "faults"),
    "browser": ("ray", "browser"),
}  # folder -> markers of its tests
SMOKE_MODULES = {
    "test_evaluate_job",
    "test_generation_jobs",
    "test_protocol_job",
    "test_publish_job",
    "test_voxel_import_job",
}
SLOW_MODULES = (
    "test_cluster_storage",
    "test_elastic",
    "test_concurrent_jobs",
    "test_faults",
    "test_train_jobs",
    "test_commands",
    "test_ablation_job",
    "test_preprocess_job",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by their folder and sort slow modules first.

    Without this order, one process may run a slow module at the end while the other processes are idle.
    """
    for item in items:
        folder, module = item.path.parent.name, item.path.stem
        for marker in MARKERS[folder]:
            item.add_marker(marker)
        if folder == "unit" and "cluster" in item.fixturenames:
            raise pytest.UsageError(f"{item.nodeid} needs Ray: move it to tests/integration")
        if "smoke" in item.fixturenames and module not in SMOKE_MODULES:
            raise pytest.UsageError(f"{item.nodeid} uses the fixture smoke: add {module} to SMOKE_MODULES")
    order = {name: place for place, name in enumerate((*sorted(SMOKE_MODULES), *SLOW_MODULES))}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log):
    """Return a scheduler that runs each module in one process.

    All SMOKE_MODULES run in the same process because they share the fixture `smoke`.
    """
    from xdist.scheduler import LoadFileScheduling

    class SmokeScheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            module = super()._split_scope(nodeid)
            return "smoke" if Path(module).stem in SMOKE_MODULES else module

    config.option.loadscopereorder = False  # keep the order of pytest_collection_modifyitems
    return SmokeScheduling(config, log)


@pytest.fixture(scope="session")
def carla_maps() -> Path:
    """Folder with the OpenDRIVE maps of CARLA in the wheel of py123d, which is a package of its own environment."""
    spec = importlib.util.find_spec("py123d")
    packages = [Path(spec.origin).parent] if spec and spec.origin else []
    packages += sorted((ROOT / ".venv-py123d").glob("lib/python*/site-packages/py123d"))
    folders = [folder for package in packages if (folder := package / "parser" / "opendrive" / "carla_maps").is_dir()]
    if not folders:
        pytest.skip("no maps of CARLA: they are part of the wheel of py123d; run 'make py123d-env'")
    return folders[0]


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder with excerpts of real drives (kitti360/, av2/).

    The folder is $PRITTI_TEST_DATA. The default is shared/data next to the repository.
    """
    path = Path(os.environ.get("PRITTI_TEST_DATA") or ROOT.parent / "shared" / "data")
    if not path.is_dir():
        pytest.skip(f"no real data: {path} does not exist; set PRITTI_TEST_DATA to a folder with kitti360/ and av2/")
    return path


@pytest.fixture(scope="session")
def cluster(tmp_path_factory):
    """One small local Ray cluster for all tests, with an empty $PRITTI_HOME."""
    from s3_server import KEYS

    from jobs.support.cli import RAY_ENVIRONMENT

    settings = {
        "PRITTI_HOME": str(tmp_path_factory.mktemp("nobody")),
        "PRITTI_CACHE": str(tmp_path_factory.mktemp("cache")),
        "RAY_AUTH_MODE": "disabled",
        "RAY_DATA_USE_DATASOURCE_V2": "0",
        "RAY_TRAIN_HEALTH_CHECK_INTERVAL_S": "0.2",
        "RAY_worker_niceness": "0",  # workers need CPU time while another process runs tests
        "DO_NOT_TRACK": "true",
    }
    os.environ.update(RAY_ENVIRONMENT | settings | KEYS)
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    import logging

    import ray
    import ray.data

    logging.getLogger("ray").setLevel(logging.WARNING)
    logging.getLogger("ray.data").setLevel(logging.WARNING)
    ray.init(
        address="local",
        num_cpus=2,
        object_store_memory=300 * 2**20,
        logging_level="WARNING",
        log_to_driver=False,
        include_dashboard=False,
    )
    yield
    ray.shutdown()


@pytest.fixture(scope="session")
def home(tmp_path_factory, cluster) -> Path:
    """A separate $PRITTI_HOME with data, models and latents of the smoke presets."""
    path = tmp_path_factory.mktemp("home")
    os.environ["PRITTI_HOME"] = str(path)
    from jobs.implementation.train_dit import train
    from jobs.train_dit import Config

    train(Config(preset="smoke"))
    return path


@pytest.fixture(scope="session")
def smoke(tmp_path_factory, cluster) -> Path:
    """A $PRITTI_HOME with the same content as `home`, but this process trains the models without Ray Train."""
    path = tmp_path_factory.mktemp("smoke")
    os.environ["PRITTI_HOME"] = str(path)
    import jobs.support.trainer
    from jobs.implementation.train_dit import train
    from jobs.train_dit import Config

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(jobs.support.trainer, "fit", fit_here)
        train(Config(preset="smoke"))
    return path


@pytest.fixture(scope="session")
def town_drive_3() -> Drive:
    return generate_town(3)


@pytest.fixture(scope="session")
def layout_shards(tmp_path_factory) -> tuple[Shard, ...]:
    """Shards of SHARD_SIZES random scenes."""
    root, scenes = str(tmp_path_factory.mktemp("shards")), iter(range(100))
    found = tuple(Shard(root, "town", "train", k) for k in range(len(SHARD_SIZES)))
    for shard, count in zip(found, SHARD_SIZES, strict=True):
        shard.write([random_scene(next(scenes), n=30) for _ in range(count)])
    return found


@pytest.fixture(scope="session")
def town_dataset(tmp_path_factory) -> str:
    """A town dataset of 8 training and 4 test scenes in three shards, with rejects and reader reports."""
    root = str(tmp_path_factory.mktemp("inspect") / "town")
    for seed, split, number, count in ((0, "train", 0, 5), (1, "train", 1, 3), (1_000_000, "test", 0, 4)):
        drive = generate_town(seed)
        poses = np.linspace(0, len(drive) - 1, count).astype(int)
        densities = ("low", "medium", "high", "medium", "medium")
        scenes = [
            replace(drive.scene(int(pose), split), vegetation_density=label, vehicle_density="medium")
            for pose, label in zip(poses, densities, strict=False)
        ]
        Shard(root, "town", split, number).write(scenes)
    lost = [
        {"scene_id": f"town-00000-{k:010d}", "sequence": "00000", "frame": k, "reason": REJECT_REASON} for k in (1, 2)
    ]
    storage.write_parquet(make_rejects_table(lost), Shard(root, "town", "train", 0).path("rejects"))
    report = {"objects": 9, "boxes": 5, "dropped": {"bridge": 2}, "duplicates": 1}
    defects = {"defects": [{"index": 7, "label": "car", "reason": "sheared flat"}]}
    thresholds = {"count_p25": 10.0, "count_p75": 90.0, "volume_p25_m3": 100.0, "volume_p75_m3": 9000.0}
    description = {
        "source": "town",
        "options": {"num_train": 8, "seed": 0},
        "scenes": {"train": 8, "test": 4},
        "layout": LayoutSpec(categories=tuple(TOWN_SLOTS), slots=tuple(TOWN_SLOTS.values())).to_dict(),
        "vegetation_thresholds": thresholds,
        "vehicle_thresholds": thresholds,
        "reports": {"00000": report | {"defects": []}, "00001": report | defects},
    }
    storage.write_json(description, f"{root}/dataset.json")
    return root


@pytest.fixture(scope="session")
def reconstruction_dataset(tmp_path_factory) -> Path:
    """Two shards of 7 and 4 scenes, and an LVAE that predicts only the means of the scenes."""
    import torch

    from models.lvae import LayoutVAE
    from models.tensors import make_layout_batch
    from models.vae.config import GroundConfig, ObjectConfig

    root = tmp_path_factory.mktemp("rebuild")
    scenes = [random_scene(k, n=25, split="test") for k in range(11)]
    for number, part in enumerate((scenes[:7], scenes[7:])):
        Shard(str(root), "town", "test", number).write(part)
    torch.manual_seed(0)
    spec = small_spec(pixels=64)
    model = LayoutVAE(
        spec.to_dict(),
        latent_channels=4,
        ground=GroundConfig((8, 16, 16), norm_groups=4),
        objects=ObjectConfig(width=32, layers=1, heads=2, hidden=32, head_hidden=32),
    )
    model.init_from_data(make_layout_batch(scenes, spec))
    model.save_pretrained(root / "lvae")
    return root


@pytest.fixture(scope="session")
def controlnet_weights(tmp_path_factory) -> tuple[str, str]:
    """Directories of a Stable Diffusion pipeline and its ControlNet: 32 channels, random weights."""
    import torch
    from diffusers import (
        AutoencoderKL,
        ControlNetModel,
        DDIMScheduler,
        StableDiffusionPipeline,
        UNet2DConditionModel,
    )
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

    torch.manual_seed(0)
    root = tmp_path_factory.mktemp("weights")
    words = [
        "<|startoftext|>",
        "<|endoftext|>",
        *"abcdefghijklmnopqrstuvwxyz",
        *(f"{c}</w>" for c in "abcdefghijklmnopqrstuvwxyz"),
    ]
    (root / "vocab.json").write_text(json.dumps({word: k for k, word in enumerate(words)}))
    (root / "merges.txt").write_text("#version: 0.2\n")
    tokenizer = CLIPTokenizer(str(root / "vocab.json"), str(root / "merges.txt"), model_max_length=77)
    text = CLIPTextModel(
        CLIPTextConfig(
            vocab_size=len(words),
            hidden_size=32,
            intermediate_size=37,
            num_hidden_layers=2,
            num_attention_heads=4,
            bos_token_id=0,
            eos_token_id=1,
        )
    )
    common = {
        "block_out_channels": (32, 64),
        "layers_per_block": 1,
        "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D"),
        "cross_attention_dim": 32,
        "norm_num_groups": 8,
        "attention_head_dim": 8,
    }
    unet = UNet2DConditionModel(
        sample_size=32, in_channels=4, out_channels=4, up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"), **common
    )
    controlnet = ControlNetModel(in_channels=4, conditioning_embedding_out_channels=(16, 32), **common)
    embedding = controlnet.controlnet_cond_embedding.conv_out
    for block in (*controlnet.controlnet_down_blocks, controlnet.controlnet_mid_block, embedding):
        torch.nn.init.normal_(block.weight, std=0.5)  # with the initial weights of zero, the image would have no effect
    vae = AutoencoderKL(
        block_out_channels=(32, 64),
        down_block_types=("DownEncoderBlock2D",) * 2,
        up_block_types=("UpDecoderBlock2D",) * 2,
        latent_channels=4,
        norm_num_groups=8,
    )
    pipeline = StableDiffusionPipeline(
        vae,
        text,
        tokenizer,
        unet,
        DDIMScheduler(),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipeline.save_pretrained(root / "diffusion", safe_serialization=True)
    controlnet.save_pretrained(root / "controlnet", safe_serialization=True)
    return str(root / "diffusion"), str(root / "controlnet")


@pytest.fixture(scope="session")
def studio_files(tmp_path_factory) -> Path:
    """Folder with three scenes in `tables` and a pipeline with random weights in `model`."""
    root = tmp_path_factory.mktemp("studio")
    shard = Shard(str(root / "tables"), "town", "test", 0)
    shard.write([studio_scene(k) for k in range(3)])
    storage.write_parquet(make_tracks_table("given-0", make_straight_drive()), shard.path("tracks"))
    tiny_pipeline(small_spec()).save_pretrained(root / "model")
    return root


@pytest.fixture(scope="module")
def studio_url(studio_files, cluster) -> Iterator[str]:
    """URL of a studio whose model runs in a Ray actor."""
    from jobs.implementation.serve_studio import serve_studio
    from jobs.serve_studio import Config

    studio = serve_studio(Config(str(studio_files / "model"), (str(studio_files / "tables"),), port=0, num_threads=1))
    yield studio.address
    studio.stop()


@pytest.fixture(scope="session")
def gallery_scenes(town_drive_3) -> list[Scene]:
    return [town_drive_3.scene(k, "test") for k in (0, 20, 40)]


@pytest.fixture(scope="session")
def gallery_page(gallery_scenes, tmp_path_factory, cluster) -> Path:
    from jobs.implementation.inspect_scenes import write_gallery
    from jobs.inspect_scenes import Gallery

    root = tmp_path_factory.mktemp("gallery")
    Shard(str(root), "town", "test", 0).write(gallery_scenes)
    return Path(write_gallery(Gallery(dataset=str(root), title="Three <scenes>", output=str(root / "gallery.html"))))
