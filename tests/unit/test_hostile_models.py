"""Tests of model directories that are damaged or written by an attacker: each is refused by name, or loads in full."""

import json
import pickle
import resource
import shutil
import struct
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers import ROOT, small_spec, tiny_pipeline
from safetensors.torch import load_file, save_file

from models.base import MAX_CONFIG_BYTES
from models.dit import DiT
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.pipeline import PrITTIPipeline
from models.presets import LVAE_PRESETS
from models.sampling.schedulers import SchedulerConfig
from models.strict_json import parse_json
from pipelines.generation.sample import load_pipeline
from pipelines.training.latents import load_lvae

GOLDEN = ROOT / "tests" / "golden" / "version_0_1" / "pipeline"
WEIGHTS = "diffusion_pytorch_model.safetensors"


@pytest.fixture
def directory(tmp_path) -> Path:
    return Path(shutil.copytree(GOLDEN, tmp_path / "pipeline"))


def change_config(path: Path, **changes: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def change_weights(path: Path, change) -> None:
    state = {name: value.clone() for name, value in load_file(path).items()}
    change(state)
    save_file(state, path)


def measure_peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


LAYOUT = LayoutSpec().to_dict()
CONFIGS = [
    ("dit/config.json", {"depth": "6"}, r"depth is '6', expected an integer from 1 to 1000"),
    ("dit/config.json", {"depth": 10**9}, r"depth is 1000000000"),
    ("dit/config.json", {"depth": True}, r"depth is True"),
    ("dit/config.json", {"width": 10**5000}, r"width is an integer of more than 60 digits|not JSON"),
    ("dit/config.json", {"heads": 0}, r"heads is 0"),
    ("dit/config.json", {"patch": -2}, r"patch is -2"),
    ("dit/config.json", {"label": "cars"}, r"label is 'cars', expected one of: vegetation"),
    ("dit/config.json", {"label": ["vegetation"]}, r"label is \['vegetation'\]"),
    ("dit/config.json", {"num_labels": 9}, r"num_labels is 9, expected 3"),
    ("dit/config.json", {"prediction": []}, r"prediction is \[\], expected one of"),
    ("dit/config.json", {"scale": [1, 1, 1, 0]}, r"scale\[3\] is 0"),
    ("dit/config.json", {"shift": [0.0]}, r"shift has 1 entries for 4 channels"),
    ("dit/config.json", {"schedule": {"num_timesteps": 2 * 10**9}}, r"num_timesteps: 2,000,000,000 training timesteps"),
    ("dit/config.json", {"schedule": {"beta_start": 0.5, "beta_end": 0.1}}, r"beta_start is 0.5, above beta_end 0.1"),
    ("dit/config.json", {"schedule": 3}, r"schedule is 3, expected an object"),
    (
        "dit/config.json",
        {"size": 4096, "width": 512},
        r"positions of the patches: 2,147,483,648 entries of the buffers",
    ),
    ("dit/config.json", {"width": 2**16, "depth": 20}, r"parameters of a network; at most 2,000,000,000"),
    ("dit/config.json", {"auto_map": {"AutoModel": "evil.Model"}}, r"DiT has no option auto_map"),
    ("dit/config.json", {"_class_name": "LayoutVAE"}, r"_class_name is 'LayoutVAE', expected 'DiT'"),
    ("dit/config.json", {"layout": {"slots": [1]}}, r"not a LayoutSpec: layout.categories is missing"),
    ("dit/config.json", {"channels": 8, "shift": None, "scale": None}, r"weights do not fit the config.json .*shape"),
    ("lvae/config.json", {"layout": None}, r"not a LayoutSpec: layout is None"),
    ("lvae/config.json", {"layout": LAYOUT | {"slots": [-1] * 11}}, r"layout.slots\[0\] is -1"),
    ("lvae/config.json", {"layout": LAYOUT | {"slots": [10**6] * 11}}, r"layout.slots: 11,000,000 primitives"),
    ("lvae/config.json", {"layout": LAYOUT | {"categories": ["pole"] * 11}}, r"expected different names"),
    ("lvae/config.json", {"layout": LAYOUT | {"height_bounds_m": {"low": [1], "high": [1]}}}, r"less than its upper"),
    (
        "lvae/config.json",
        {"layout": LAYOUT | {"grid": LAYOUT["grid"] | {"rows": 65536, "cols": 65536}}},
        r"layout.grid:",
    ),
    ("lvae/config.json", {"layout": LAYOUT | {"grid": LAYOUT["grid"] | {"resolution_m": 0}}}, r"resolution_m is 0"),
    ("lvae/config.json", {"channels": [4, "8"]}, r"ground.channels\[1\] is '8'"),
    ("lvae/config.json", {"channels": [1] * 100}, r"ground.channels is a list of 100 entries"),
    ("lvae/config.json", {"norm_groups": 3}, r"expected multiples of norm_groups 3"),
    ("lvae/config.json", {"fold": 0}, r"ground.pixel_unshuffle is 0"),
    ("lvae/config.json", {"ground": "x"}, r"ground and \w+ exclude each other"),
    ("lvae/config.json", {"heads": 3}, r"objects.width is 8, expected a multiple of heads 3"),
    ("lvae/config.json", {"decoder": "gru"}, r"objects.decoder is 'gru', expected one of: detr, cells"),
    ("lvae/config.json", {"latent_channels": 1.0}, r"latent_channels is 1.0"),
    ("model_index.json", {"noise_scaling": 2}, r"noise_scaling is 2, expected a number from 0.9 to 1.1"),
    ("model_index.json", {"existence_threshold": "0"}, r"existence_threshold is '0'"),
    ("model_index.json", {"scheduler": ["os", "system"]}, r"scheduler is \['os', 'system'\]"),
    ("model_index.json", {"scheduler": ["diffusers", 3]}, r"scheduler\[1\] is 3"),
    ("model_index.json", {"lvae": ["evil", "LayoutVAE"]}, r"lvae is \['evil', 'LayoutVAE'\]"),
    ("model_index.json", {"custom_pipeline": "evil"}, r"'custom_pipeline' is unknown"),
    ("scheduler/scheduler_config.json", {"num_train_timesteps": 2 * 10**9}, r"num_train_timesteps is 2000000000, but"),
    ("scheduler/scheduler_config.json", {"num_train_timesteps": "x"}, r"num_train_timesteps is 'x'"),
    ("scheduler/scheduler_config.json", {"trained_betas": [0.1]}, r"trained_betas is \[0.1\], but"),
    ("scheduler/scheduler_config.json", {"prediction_type": "sample"}, r"prediction_type is 'sample'"),
    ("scheduler/scheduler_config.json", {"timestep_spacing": {"a": 1}}, r"timestep_spacing is {'a': 1}"),
    ("scheduler/scheduler_config.json", {"solver": {"a": 1}}, r"'solver' is {'a': 1}, expected a plain value"),
    ("scheduler/scheduler_config.json", {"_class_name": "EvilScheduler"}, r"expected 'DDPMScheduler'"),
]


@pytest.mark.parametrize(("file", "changes", "message"), CONFIGS, ids=[f"{c[0]} {next(iter(c[1]))}" for c in CONFIGS])
def test_invalid_entry_is_named_without_taking_memory(file, changes, message, directory):
    """The refused configs ask for up to 20 GB. The test process may grow by 0.4 GB."""
    before = measure_peak_gb()
    if isinstance(changes.get("width"), int) and changes["width"] > 2**64:  # json.dumps refuses to write such a number.
        text = json.dumps(json.loads((directory / file).read_text()) | {"width": "@"}).replace('"@"', "9" * 4001)
        (directory / file).write_text(text)
    else:
        change_config(directory / file, **changes)
    with pytest.raises(ValueError, match=message) as caught:
        load_pipeline(str(directory))
    assert Path(file).name in str(caught.value) or "scheduler" in file
    assert measure_peak_gb() - before < 0.4


@pytest.mark.parametrize("file", ["dit/config.json", "model_index.json", "scheduler/scheduler_config.json"])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[" * 200_000, "not JSON: the values are nested too deeply"),
        (b'{"a": NaN}', "NaN is not a JSON number"),
        (b'{"a": 1e999}', "exceeds the range"),
        (b'{"a": 1, "a": 2}', "'a' occurs twice"),
        (b"\xff\xfe{", "not JSON"),
        (b"3", "expected a JSON object, got a int"),
        (b" " * (MAX_CONFIG_BYTES + 1), "expected a regular file of at most 1,048,576 bytes"),
    ],
    ids=["deep", "nan", "infinity", "twice", "encoding", "number", "large"],
)
def test_config_is_strict_json(file, content, message, directory):
    (directory / file).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        PrITTIPipeline.from_pretrained(directory)


def remove_half(state):
    for name in sorted(state)[::2]:
        del state[name]


def add_tensor(state):
    state["evil"] = torch.zeros(3)


def write_nan(state):
    state[sorted(state)[3]].view(-1)[-1] = float("nan")


def write_infinity(state):
    state[sorted(state)[3]].view(-1)[0] = -float("inf")


def write_integers(state):
    state.update({name: value.long() for name, value in state.items()})


def mix_types(state):
    first = sorted(state)[0]
    state[first] = state[first].half()


def flatten_first(state):
    first = sorted(state)[0]
    state[first] = state[first].reshape(-1)[:, None]


@pytest.mark.parametrize("part", ["dit", "lvae"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (remove_half, r"\d+ of \d+ tensors are missing, such as "),
        (add_tensor, "1 tensors are not in the model, such as 'evil'"),
        (write_nan, "expected finite numbers"),
        (write_infinity, "expected finite numbers"),
        (write_integers, "has the data type I64"),
        (mix_types, "expected one data type"),
        (flatten_first, "has the shape"),
    ],
)
def test_weights_are_complete_and_finite(part, change, message, directory):
    change_weights(directory / part / WEIGHTS, change)
    with pytest.raises(ValueError, match=message) as caught:
        PrITTIPipeline.from_pretrained(directory)
    assert str(directory / part / WEIGHTS) in str(caught.value)
    if part == "lvae":
        with pytest.raises(ValueError, match=message):
            load_lvae(str(directory / "lvae"))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\0" * 7,
        struct.pack("<Q", 2**63),
        struct.pack("<Q", 50_000_000) + b"{" * 100,
        struct.pack("<Q", 8) + b"[" * 8,
        struct.pack("<Q", 2) + b"{}",
    ],
)
def test_damaged_header_is_refused(content, directory):
    (directory / "dit" / WEIGHTS).write_bytes(content)
    with pytest.raises(ValueError, match=WEIGHTS):
        PrITTIPipeline.from_pretrained(directory)


def test_truncated_weights_are_refused(directory):
    path = directory / "dit" / WEIGHTS
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match="the file is damaged"):
        PrITTIPipeline.from_pretrained(directory)


def test_other_weight_formats_are_not_opened(directory):
    """Pickles, shards and indexes next to the config are ignored; a pickle alone is no model."""
    ran = directory / "ran"

    class Evil:
        def __reduce__(self):
            return open, (str(ran), "w")

    for name in ("diffusion_pytorch_model.bin", "pytorch_model.bin", "model.pth"):
        (directory / "dit" / name).write_bytes(pickle.dumps(Evil()))
    index = {"weight_map": dict.fromkeys(["patch_in.weight"], "../../../etc/passwd")}
    (directory / "dit" / f"{WEIGHTS}.index.json").write_text(json.dumps(index))
    PrITTIPipeline.from_pretrained(directory)
    (directory / "dit" / WEIGHTS).unlink()
    with pytest.raises(ValueError, match="no such file"):
        PrITTIPipeline.from_pretrained(directory)
    assert not ran.exists()


def test_loaded_model_equals_saved_model(tmp_path):
    """Loading skips the random initialisation, but parameters and computed buffers have the same values."""
    architecture = LVAE_PRESETS["smoke"].architecture()
    models = [
        LayoutVAE(layout=small_spec().to_dict(), **architecture),
        LayoutVAE(layout=small_spec().to_dict(), **architecture | {"shortcut": True, "branches": "objects"}),
        tiny_pipeline(small_spec()).lvae,
        tiny_pipeline(small_spec()).dit,
    ]
    for model in models:
        before = torch.random.get_rng_state()
        model.save_pretrained(tmp_path)
        loaded = type(model).from_pretrained(tmp_path)
        assert torch.equal(torch.random.get_rng_state(), before) and loaded.config == model.config
        for members in ("named_parameters", "named_buffers"):
            ours, theirs = (dict(getattr(one, members)()) for one in (model, loaded))
            assert list(ours) == list(theirs)
            for name, value in ours.items():
                assert theirs[name].device == value.device and theirs[name].dtype == value.dtype
                assert torch.equal(theirs[name], value), name
        assert not loaded.training


def test_latents_that_are_not_finite_give_no_empty_scene(directory):
    """Damaged weights may be finite, but so large that the network overflows."""
    change_weights(directory / "dit" / WEIGHTS, lambda state: [value.fill_(1e30) for value in state.values()])
    with pytest.raises(ValueError, match="a latent holds NaN or infinity"):
        load_pipeline(str(directory)).generate(["low"], num_inference_steps=2)


def test_half_precision_weights_load_as_float32(directory):
    change_weights(directory / "dit" / WEIGHTS, lambda state: state.update({k: v.bfloat16() for k, v in state.items()}))
    assert PrITTIPipeline.from_pretrained(directory).dit.dtype == torch.float32
    assert PrITTIPipeline.from_pretrained(directory, torch.bfloat16).lvae.dtype == torch.bfloat16


def test_pipeline_requires_latents_of_equal_shape():
    pipeline = tiny_pipeline(small_spec())
    channels, size, _ = pipeline.lvae.latent_shape
    with pytest.raises(ValueError, match="the DiT generates latents of the shape"):
        PrITTIPipeline(pipeline.lvae, DiT(channels=channels + 1, size=size, width=32, depth=1, heads=2))


def test_unknown_scheduler_is_refused(directory):
    change_config(directory / "model_index.json", scheduler=["diffusers", "StableDiffusionPipeline"])
    change_config(directory / "scheduler/scheduler_config.json", _class_name="StableDiffusionPipeline")
    with pytest.raises(ValueError, match="the class of the scheduler is 'StableDiffusionPipeline', expected one of"):
        PrITTIPipeline.from_pretrained(directory)
    with pytest.raises(ValueError, match="diffusers does not accept the options"):
        SchedulerConfig("DDPMScheduler", {"beta_schedule": "evil"}).build()


def test_repeated_key_is_found_in_linear_time():
    text = "{" + ",".join(f'"{k}":0' for k in range(100_000)) + ',"99999":1}'
    start = time.perf_counter()
    with pytest.raises(ValueError, match="'99999' occurs twice"):
        parse_json(text.encode())
    assert time.perf_counter() - start < 20  # A quadratic search would take minutes.


def test_label_kind_of_damaged_config_is_named(directory):
    from jobs.support.model_directories import read_label_kind

    assert read_label_kind(str(directory)) == "vegetation"
    for label, message in ((None, "label is None"), ({"a": 1}, "label is {'a': 1}")):
        change_config(directory / "dit/config.json", label=label)
        with pytest.raises(ValueError, match=message):
            read_label_kind(str(directory))
    (directory / "dit/config.json").write_text("[]")
    with pytest.raises(ValueError, match=r"config\.json: the config is \[\], expected an object"):
        read_label_kind(str(directory))


# --------------------------------------------------------------------------------------------------------- registry


class FakeRegistry:
    """Client of an MLflow server that answers with chosen values."""

    def __init__(self, run_id: object, source: Path) -> None:
        self.run_id, self.source, self.calls = run_id, source, []

    def get_model_version(self, name, version):
        return SimpleNamespace(run_id=self.run_id)

    def download_artifacts(self, run_id, path, target):
        self.calls.append(run_id)
        return str(shutil.copytree(self.source, Path(target, path), symlinks=True))


@pytest.fixture
def registry(directory, tmp_path, monkeypatch):
    from jobs.support import registry
    from models.pretrained import compute_checksums

    monkeypatch.setenv("PRITTI_HOME", str(tmp_path / "home"))
    (directory / "checksums.json").write_text(json.dumps(compute_checksums(directory)))
    server = FakeRegistry("0123456789abcdef" * 2, directory)
    monkeypatch.setattr(registry, "make_client", lambda uri: server)
    return server


@pytest.mark.parametrize("run_id", ["../../escape", "/etc", "", None, 7, "0" * 31, "0" * 33, "0" * 31 + "\n", "G" * 32])
def test_run_id_of_server_is_checked_before_use_as_path(run_id, registry, tmp_path):
    from jobs.support.registry import download_pipeline

    registry.run_id = run_id
    with pytest.raises(ValueError, match="no id of an MLflow run"):
        download_pipeline("models:/town/1")
    assert not registry.calls and not (tmp_path / "escape").exists()


def test_reference_is_checked(registry):
    from jobs.support.registry import download_pipeline

    assert Path(download_pipeline("models:/town/1")).name == registry.run_id
    for reference in ("models:/town/../1", "models:/town/latest", "models:/town/1\n", "models:/a/b/1"):
        with pytest.raises(ValueError, match="expected models:/NAME/VERSION"):
            download_pipeline(reference)


@pytest.mark.parametrize(
    ("content", "message"),
    [("[]", "expected an object"), ('{"a": 1}', "expected a SHA-256 digest"), ("{", "no checksums"), ("{}", "match")],
)
def test_checksums_of_server_are_checked(content, message, registry, directory):
    from jobs.support.registry import download_pipeline

    (directory / "checksums.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        download_pipeline("models:/town/1")


def test_links_in_download_are_refused(registry, directory):
    from jobs.support.registry import download_pipeline

    (directory / "dit" / "extra.json").symlink_to("/etc/hostname")
    with pytest.raises(ValueError, match="only regular files"):
        download_pipeline("models:/town/1")
