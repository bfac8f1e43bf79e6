"""Measure sampling and training of the paper's networks on a GPU, without Ray and without internet access.

    python benchmarks/gpu.py --output DIR --scenes town.safetensors        all sections; `learn` takes up to 8 minutes
    python benchmarks/gpu.py --output DIR --only latency train_dit
    python benchmarks/gpu.py --output DIR --only learn --scenes town.safetensors      continues where it stopped
    python benchmarks/gpu.py --output DIR --cpu                    rehearsal with tiny networks, a minute
    python benchmarks/gpu.py --write-scenes town.safetensors       town scenes for train_lvae, precision, learn

The script needs models/ and its packages. Where this project is not installed, set PYTHONPATH=. in its root. Only
--write-scenes also needs pipelines/.

The sections:

* latency: time of a scene with 250 and with 20 steps (batch 1; DiT-B, L and XL) after a first scene, share of decoding,
  time of that first scene, and peak memory; without a CUDA graph only for DiT-B
* throughput: denoising steps of batches, and the share of the GPU's peak (MFU)
* train_dit, train_lvae: time, MFU and peak memory of a training step (DiT-B at batch 256, layout VAE at batch 32),
  compiled and not compiled; share of matching for nearly untrained weights and for predictions near the truth
* precision: losses of 200 steps in bfloat16 and in float32, from the same weights, noise and data
* learn: training of a layout VAE with the DETR decoder on town scenes, of which 16 are held out and scored

Each section adds its rows to DIR/gpu.json and writes DIR/gpu.md, with the commit that git finds or that the environment
variable COMMIT states. Weights are random except in `learn`. MFU divides the operations that torch counts by the time
and by --peak-tflops (H100 and H200, bfloat16: 989). Training batches are already on the GPU.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import time
import traceback
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # Torch reads this value when it is loaded (models/__init__.py).

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from models.batch import LayoutBatch
from models.dit import DiT
from models.execution import SamplingExecution, require_bf16
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.pipeline import PrITTIPipeline
from models.presets import DIT_PRESETS, LVAE_PRESETS, DiTConfig, DiTPreset, LVAEPreset
from models.training import (
    ExecutionConfig,
    Trainer,
    count_flops,
    make_dit_settings,
    make_dit_trainer,
    make_lvae_settings,
    make_lvae_trainer,
)
from models.vae import losses
from models.vae.accuracy import compute_accuracy, pair_primitives

ROOT = Path(__file__).parents[1]
LEARN_SECONDS = 480.0
SAVE_SECONDS = 60.0  # Interval of the checkpoints of `learn`.
FIELDS = ("height", "occupied", "features", "real")
MAX_SCENES_BYTES = 20_000_000
STEPS_IN_A_ROW = 4  # Training steps between two waits for the GPU.
HELD_OUT = 16  # Scenes of `learn` that are not trained on.
DIT_NAMES = {"kitti360": "DiT-B", "kitti360-l": "DiT-L", "kitti360-xl": "DiT-XL"}
# One scene with 250 steps (table of generation results), and targets for DiT-B. The paper does not state the GPU of its
# times and of its memory.
PAPER_LATENCY = {"kitti360": "0.58", "kitti360-l": "1.78", "kitti360-xl": "2.11"}
TARGET_LATENCY, TARGET_MEMORY, PAPER_MEMORY = "<= 0.15", "<= 0.6", "0.89"


@dataclass(frozen=True)
class Row:
    """A measured value.

    Attributes:
        quantity: What was measured.
        value: Value.
        unit: Unit of the value.
        target: Target with a comparison, such as "<= 0.15". Empty: none.
        paper: Value of the paper. Empty: none.
        note: Conditions.
    """

    quantity: str
    value: float
    unit: str
    target: str = ""
    paper: str = ""
    note: str = ""


@dataclass(frozen=True)
class Setup:
    """Device, sizes and options of all sections.

    Attributes:
        device: Device.
        tiny: Whether the networks and counts are tiny.
        peak_tflops: Peak of the device for matrix products in bfloat16 (TFLOP/s).
        output: Directory of results and checkpoints.
        scenes: File of scenes. Empty: random layouts.
        steps: Number of training steps of `learn`.
    """

    device: torch.device
    tiny: bool
    peak_tflops: float
    output: Path
    scenes: str
    steps: int

    def choose(self, full: int, tiny: int) -> int:
        """Return a count for the full run or for the rehearsal."""
        return tiny if self.tiny else full

    def find_dit_preset(self, name: str) -> DiTPreset:
        """Return a preset, with a tiny network in the rehearsal."""
        preset = DIT_PRESETS[name]
        return replace(preset, model=DiTConfig(2, 2, 32, 2)) if self.tiny else preset

    def find_lvae_preset(self, name: str) -> LVAEPreset:
        """Return a preset; in the rehearsal, the smallest one."""
        return LVAE_PRESETS["smoke" if self.tiny else name]

    def make_spec(self, preset: LVAEPreset) -> LayoutSpec:
        """Return the layout of scenes with the rasters of a preset."""
        return LayoutSpec().with_resolution(preset.raster_px)

    def make_lvae(self, name: str) -> LayoutVAE:
        preset = self.find_lvae_preset(name)
        torch.manual_seed(0)
        return LayoutVAE(layout=self.make_spec(preset).to_dict(), **preset.architecture())

    def make_pipeline(self, name: str) -> PrITTIPipeline:
        """Return a pipeline with random weights on the device; the encoders remain on the CPU.

        Weights are drawn on the device, because the CPU needs several seconds for those of DiT-XL.
        """
        preset = self.find_dit_preset(name)
        lvae = self.make_lvae(preset.lvae)
        channels, size, _ = lvae.latent_shape
        with self.device:
            dit = DiT(**preset.architecture(), channels=channels, size=size, layout=dict(lvae.config.layout))
        for layer in (*dit.list_modulations(), dit.patch_out):  # They are zero at the start of a training.
            torch.nn.init.normal_(layer.weight, std=0.02)
        pipeline = PrITTIPipeline(lvae, dit)
        pipeline.dit.to(self.device)
        for decoder in (lvae.ground_decoder, lvae.object_decoder):
            if decoder is not None:
                decoder.to(self.device)
        pipeline.set_progress_bar_config(disable=True)
        return pipeline

    def synchronise(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def time_call(self, call: Callable[[], object], repeats: int, warm_up: int = 2) -> float:
        """Return the median wall-clock time of a call (s), with the work of the GPU."""
        seconds = []
        for k in range(warm_up + repeats):
            self.synchronise()
            started = time.perf_counter()
            call()
            self.synchronise()
            if k >= warm_up:
                seconds.append(time.perf_counter() - started)
        return statistics.median(seconds)

    def time_step(self, step: Callable[[], object], repeats: int) -> float:
        """Return the median wall-clock time of a training step (s).

        Each repetition takes STEPS_IN_A_ROW steps and waits for the GPU at its end. The trainer itself waits for the
        loss of each step, and prepares the next step during the backward pass, as in a training.
        """

        def run_steps() -> None:
            for _ in range(STEPS_IN_A_ROW):
                step()

        return self.time_call(run_steps, repeats, warm_up=1) / STEPS_IN_A_ROW

    def measure_mfu(self, operations: float, seconds: float) -> float:
        """Return the share of the device's peak."""
        return operations / seconds / (self.peak_tflops * 1e12)


@contextmanager
def measure_memory(setup: Setup, found: dict[str, float]) -> Iterator[None]:
    """Store the peak of allocated GPU memory (GB), with the weights, under "peak_gb"; nothing on a CPU."""
    if setup.device.type == "cuda":
        torch.cuda.synchronize(setup.device)
        gc.collect()  # Compiled networks are parts of reference cycles.
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(setup.device)
    yield
    if setup.device.type == "cuda":
        found["peak_gb"] = torch.cuda.max_memory_allocated(setup.device) / 1e9


# ------------------------------------------------------------------------------------------------------- sampling


def measure_scene(setup: Setup, pipeline: PrITTIPipeline, steps: int) -> tuple[float, float, float]:
    """Return the times of sampling the first scene and a later scene, and of decoding a scene (s).

    The first call compiles the network, computes the modulations and captures the CUDA graph, depending on the
    execution. Later calls with the same timesteps and labels share them. A pipeline compiles its network once, so a
    second number of steps needs no compilation.
    """

    def sample() -> torch.Tensor:
        return pipeline.sample_latents(["low"], 0, [0], steps)

    first = setup.time_call(sample, 1, warm_up=0)
    latents, identity = sample(), pipeline.new_identity("gpu", 0, 0, "low")
    sampling = setup.time_call(sample, setup.choose(5, 2), warm_up=0)
    return first, sampling, setup.time_call(lambda: pipeline.decode(latents, [identity]), setup.choose(5, 2))


def run_latency(setup: Setup) -> Iterator[Row]:
    """Measure the time of one scene."""
    graphs, base = "bfloat16, CUDA graph", "kitti360"
    executions = {
        "float32": SamplingExecution(),
        "bfloat16": SamplingExecution("bf16"),
        graphs: SamplingExecution("bf16", cuda_graphs=True),
        f"{graphs}, compiled": SamplingExecution("bf16", cuda_graphs=True, compile=True),
    }
    if setup.tiny:
        del executions[f"{graphs}, compiled"]  # Compiling takes longer than the rehearsal.
    for name, label in DIT_NAMES.items():
        for kind, execution in executions.items():
            if name != base and graphs not in kind and not setup.tiny:
                continue  # The large networks are measured with the fast executions only.
            pipeline, memory = setup.make_pipeline(name), {}
            pipeline.set_execution(execution)
            with measure_memory(setup, memory):
                for steps in (setup.choose(250, 10), setup.choose(20, 5)):
                    first, sampling, decoding = measure_scene(setup, pipeline, steps)
                    target, paper = "", ""
                    if steps == 250:
                        paper = PAPER_LATENCY[name]
                        target = TARGET_LATENCY if graphs in kind and name == base else ""
                    note = f"decoding {100 * decoding / (sampling + decoding):.0f} %"
                    quantity = f"{label}, one scene, {steps} steps, {kind}"
                    yield Row(quantity, sampling + decoding, "s", target, paper, note)
                    yield Row(f"{quantity}, first scene", first, "s", note="with set-up; no decoding")
            if memory:
                target, paper = (TARGET_MEMORY, PAPER_MEMORY) if name == base and kind == graphs else ("", "")
                quantity = f"{label}, peak memory, batch 1, {kind}"
                yield Row(quantity, memory["peak_gb"], "GB", target, paper, "without encoders")


def count_denoising_step(setup: Setup, pipeline: PrITTIPipeline) -> float:
    """Count the operations of a denoising step of one latent, with its modulations."""
    latent = torch.zeros(1, *pipeline.latent_shape, device=setup.device)
    ids = torch.zeros(1, dtype=torch.long, device=setup.device)
    return count_flops(lambda: pipeline.dit(latent, ids, ids))


@torch.no_grad()
def run_throughput(setup: Setup) -> Iterator[Row]:
    """Measure denoising steps of batches."""
    for name, label in DIT_NAMES.items():
        pipeline = setup.make_pipeline(name)
        operations = count_denoising_step(setup, pipeline)
        pipeline.set_execution(SamplingExecution("bf16", cuda_graphs=True))
        for batch in (setup.choose(8, 2), setup.choose(32, 4), setup.choose(128, 8)):
            timestep = torch.full((batch,), 500, device=setup.device)
            classes = torch.zeros(batch, dtype=torch.long, device=setup.device)
            latent = torch.randn(batch, *pipeline.latent_shape, device=setup.device)
            denoise = pipeline.make_denoiser(torch.tensor([500]), classes)
            seconds = setup.time_call(partial(denoise, latent, timestep, classes), setup.choose(20, 3), 3)
            rate, mfu = batch / (250 * seconds), setup.measure_mfu(batch * operations, seconds)
            note = "250 times one step; no noise, sampler or decoding"
            yield Row(f"{label}, network of sampling, batch {batch}", rate, "scenes/s", note=note)
            yield Row(f"{label}, MFU of a denoising step, batch {batch}", 100 * mfu, "%")


# ------------------------------------------------------------------------------------------------------- training


def load_scenes(path: str) -> dict[str, np.ndarray]:
    """Read compact layouts (`tensors.encode_layout`) from a file of `write_scenes`; see there."""
    try:
        stored = load_file(path)
        shapes = json.loads(stored["shapes"].tobytes())
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise ValueError(f"--scenes {path}: {error}; make this file with --write-scenes FILE") from error
    found = {}
    for name in FIELDS:
        kind, shape = shapes[name]
        flat: np.ndarray = np.frombuffer(zlib.decompress(stored[name].tobytes()), np.dtype(kind))
        if name == "occupied":
            flat = np.unpackbits(flat.view(np.uint8), count=int(np.prod(shape))).astype(bool)
        if name == "height":
            flat = np.cumsum(flat.reshape(-1, shape[-1]), axis=1, dtype=np.uint16)
        found[name] = flat.reshape(shape)
    return found


def write_scenes(path: Path, count: int) -> None:
    """Write town scenes as compact layouts of the preset kitti360, compressed without loss, as safetensors.

    Heights are stored as differences along the columns (modulo 65536), occupancy as bits.
    """
    from models.scene import Grid
    from models.tensors import encode_layout
    from pipelines.preprocess.sources.town.generator import generate_town

    spec, rows = LayoutSpec(), []
    for seed in range(-(-count // 16)):
        drive = generate_town(1000 + seed)
        poses = np.linspace(0, len(drive) - 1, min(16, count - len(rows))).astype(int)
        rows += [encode_layout(drive.scene(int(k), "train", Grid()), spec) for k in poses]
    arrays = {name: np.stack([row[name] for row in rows]) for name in FIELDS}
    shapes = {name: [value.dtype.str, value.shape] for name, value in arrays.items()}
    shapes["occupied"][0] = "|u1"
    height = arrays["height"]
    packed = arrays | {
        "occupied": np.packbits(arrays["occupied"]),
        "height": np.diff(height, axis=-1, prepend=np.zeros_like(height[..., :1])),
    }
    blobs = {name: np.frombuffer(zlib.compress(packed[name].tobytes(), 9), np.uint8) for name in FIELDS}
    save_file(blobs | {"shapes": np.frombuffer(json.dumps(shapes).encode(), np.uint8)}, path)
    size = path.stat().st_size
    if size > MAX_SCENES_BYTES:
        path.unlink()
        raise ValueError(f"{count} scenes need {size:,} bytes, more than {MAX_SCENES_BYTES:,}; lower --num-scenes")
    print(f"{path}: {count} scenes, {size:,} bytes")


class Layouts:
    """Compact layouts from a file, or random ones.

    Args:
        setup: Options.
        spec: LayoutSpec of the scenes. The rasters of a file must have its resolution.
    """

    def __init__(self, setup: Setup, spec: LayoutSpec) -> None:
        self.device, self.spec = setup.device, spec
        if setup.scenes:
            self.arrays = load_scenes(setup.scenes)
            shape = self.arrays["height"].shape[-2:]
            if shape != (spec.grid.rows, spec.grid.cols):
                raise ValueError(f"{setup.scenes}: rasters of {shape} pixels, expected {spec.grid.rows}")
            self.num_held_out = min(HELD_OUT, len(self.arrays["real"]) // 4)
            return
        rng, count, slots = np.random.default_rng(0), 8, sum(spec.slots)
        raster = (count, len(spec.ground_classes), spec.grid.rows, spec.grid.cols)
        real = np.concatenate([np.arange(n) < rng.integers(0, 1 + n // 2) for n in spec.slots])
        self.arrays = {
            "height": rng.integers(0, 65536, raster, np.uint16),
            "occupied": rng.random(raster) < 0.3,
            "features": rng.random((count, slots, 9), np.float32) * real[:, None],
            "real": np.tile(real, (count, 1)),
        }

        self.num_held_out = len(self.arrays["real"]) // 4

    def __len__(self) -> int:
        return len(self.arrays["real"]) - self.num_held_out

    def select(self, scenes: slice) -> dict[str, torch.Tensor]:
        """Return scenes by their position in the file; those from `len(self)` are never drawn for training."""
        return {name: torch.from_numpy(value[scenes].copy()).to(self.device) for name, value in self.arrays.items()}

    def draw(self, step: int, batch: int) -> dict[str, torch.Tensor]:
        """Return a batch of a step; every epoch has another order."""
        first, order = step * batch, []
        for place in range(first, first + batch):
            epoch, k = divmod(place, len(self))
            order.append(np.random.default_rng(epoch).permutation(len(self))[k])
        return {name: torch.from_numpy(value[order]).to(self.device) for name, value in self.arrays.items()}


def draw_posteriors(trainer: Trainer, batch: int, seed: int = 0) -> dict[str, torch.Tensor]:
    """Return random posteriors and labels for a DiT."""
    config, generator = trainer.model.config, torch.Generator().manual_seed(seed)
    shape = batch, config.channels, config.size, config.size
    arrays = {
        "mean": torch.randn(shape, generator=generator),
        "logvar": torch.full(shape, -8.0),
        "label": torch.randint(config.num_labels, (batch,), generator=generator),
    }
    return {name: value.to(trainer.device) for name, value in arrays.items()}


def make_dit_for_training(setup: Setup, precision: str, compiled: bool = False) -> Trainer:
    """Return a trainer of DiT-B with equal initial weights in each call."""
    preset, shape = setup.find_dit_preset("kitti360"), setup.make_lvae("kitti360").latent_shape
    torch.manual_seed(0)
    dit = DiT(**preset.architecture(), channels=shape[0], size=shape[1])
    settings = make_dit_settings(preset)
    execution = ExecutionConfig(precision=precision, compile=compiled)
    return make_dit_trainer(dit, settings, preset.label_dropout, setup.device, execution=execution)


def make_lvae_for_training(
    setup: Setup, precision: str, steps: int = 0, batch: dict | None = None, compiled: bool = False
) -> Trainer:
    preset, lvae = setup.find_lvae_preset("kitti360"), setup.make_lvae("kitti360")
    lvae.to(setup.device)
    if batch is not None and preset.init_from_data:
        lvae.init_from_data(LayoutBatch.from_compact(batch))
    settings = make_lvae_settings(replace(preset, steps=steps or preset.steps))
    execution = ExecutionConfig(precision=precision, compile=compiled)
    return make_lvae_trainer(lvae, settings, preset.kl_weight, setup.device, execution=execution)


def find_fitting_batch(batch: int, attempt: Callable[[int], object]) -> int:
    """Return the largest of batch, batch / 2, ... for which `attempt` does not run out of memory.

    Raises:
        ValueError: Even one sample does not fit.
    """
    while batch:
        try:
            attempt(batch)
        except torch.OutOfMemoryError:
            torch.cuda.empty_cache()
            batch //= 2
        else:
            return batch
    raise ValueError("one sample does not fit in the memory of this GPU; use a GPU with more memory")


def count_training_step(trainer: Trainer) -> float:
    """Count the operations of the forward and backward pass of one latent."""
    one = draw_posteriors(trainer, 1)
    return count_flops(lambda: trainer.model(one["mean"], one["label"], one["label"]).square().mean().backward())


def run_train_dit(setup: Setup) -> Iterator[Row]:
    """Measure training steps of DiT-B."""
    wanted, operations = setup.choose(256, 4), 0.0
    for compiled in (False,) if setup.tiny else (False, True):
        trainer, memory = make_dit_for_training(setup, "bf16", compiled), {}

        def step(arrays: dict[str, torch.Tensor], trainer: Trainer = trainer) -> None:
            trainer.step(arrays, range(len(arrays["label"])))

        def attempt(batch: int, trainer: Trainer = trainer) -> None:
            trainer.step(draw_posteriors(trainer, batch), range(batch))

        batch = find_fitting_batch(wanted, attempt)
        operations = operations or count_training_step(trainer)  # Compiled parts cannot be counted.
        with measure_memory(setup, memory):
            seconds = setup.time_step(partial(step, draw_posteriors(trainer, batch)), setup.choose(5, 1))
        mfu = setup.measure_mfu(batch * operations, seconds)
        note = describe_execution(compiled) + describe_fit(wanted, batch)
        yield Row(f"DiT-B, training step, batch {batch}, bfloat16", seconds, "s", note=note)
        yield Row("DiT-B, MFU of training", 100 * mfu, "%", ">= 50", note=note)
        if memory:
            yield Row("DiT-B, peak memory of training", memory["peak_gb"], "GB", note=note)


def describe_execution(compiled: bool) -> str:
    return "compiled" if compiled else "not compiled"


def describe_fit(wanted: int, batch: int) -> str:
    """Return a note for a batch that is smaller than the wanted one."""
    return f"; batch {wanted} does not fit in the memory, {batch} fits" if batch < wanted else ""


def measure_matching(setup: Setup, step: Callable[[], object]) -> float:
    """Return the median time of matching within training steps (s), with the work of the GPU."""
    match, seconds = losses.match_primitives, []

    def match_timed(*arguments):
        setup.synchronise()
        started = time.perf_counter()
        found = match(*arguments)
        seconds.append(time.perf_counter() - started)
        return found

    losses.match_primitives = match_timed
    try:
        setup.time_step(step, setup.choose(3, 1))
    finally:
        losses.match_primitives = match
    return statistics.median(seconds)


def make_matching_near_truth(arrays: dict[str, torch.Tensor], spec: LayoutSpec) -> Callable[[], object]:
    """Return a call that matches the primitives of layouts with noisy copies (2 % of the range of each feature).

    Predictions of untrained weights are nearly equal for all primitives, so they are matched more slowly.
    """
    batch = LayoutBatch.from_compact(arrays)
    near = (batch.features + 0.02 * torch.randn_like(batch.features)).clamp(0, 1)
    logit = torch.where(batch.real, 3.0, -3.0)
    return partial(losses.match_primitives, near, logit, batch.features, batch.real, spec.slots, spec.slots)


def run_train_lvae(setup: Setup) -> Iterator[Row]:
    """Measure training steps of the layout VAE and the share of matching."""
    wanted, operations = setup.choose(32, 2), 0.0
    layouts = Layouts(setup, setup.make_spec(setup.find_lvae_preset("kitti360")))
    for compiled in (False,) if setup.tiny else (False, True):
        trainer, memory = make_lvae_for_training(setup, "bf16", compiled=compiled), {}

        def step(arrays: dict[str, torch.Tensor], trainer: Trainer = trainer) -> None:
            trainer.step(arrays, range(len(arrays["real"])))

        batch = find_fitting_batch(wanted, lambda batch, step=step: step(layouts.draw(0, batch)))
        arrays = layouts.draw(0, batch)
        operations = operations or count_flops(partial(step, layouts.draw(0, 1)))  # Compiled parts cannot be counted.
        with measure_memory(setup, memory):
            seconds = setup.time_step(partial(step, arrays), setup.choose(5, 1))
        matching_s = measure_matching(setup, partial(step, arrays))
        scenes = Path(setup.scenes).name if setup.scenes else "random layouts"
        note = f"{describe_execution(compiled)}, {scenes}{describe_fit(wanted, batch)}"
        near_s = setup.time_call(make_matching_near_truth(arrays, layouts.spec), setup.choose(5, 1))
        yield Row(f"layout VAE, training step, batch {batch}, bfloat16", seconds, "s", note=note)
        for kind, spent in (("nearly untrained weights", matching_s), ("predictions near truth", near_s)):
            yield Row(f"layout VAE, share of matching, {kind}", 100 * spent / seconds, "%", "< 10", note=note)
        mfu = 100 * setup.measure_mfu(batch * operations, seconds)
        yield Row("layout VAE, MFU of training", mfu, "%", note=note)
        if memory:
            yield Row("layout VAE, peak memory of training", memory["peak_gb"], "GB", note=note)


def run_precision(setup: Setup) -> Iterator[Row]:
    """Compare the losses of trainings in bfloat16 and in float32."""
    steps, last = setup.choose(200, 6), setup.choose(50, 3)
    layouts = Layouts(setup, setup.make_spec(setup.find_lvae_preset("kitti360")))
    sizes = {"DiT-B": setup.choose(32, 2), "layout VAE": setup.choose(8, 2)}
    for name, batch in sizes.items():
        curves = {}
        for precision in ("fp32", "bf16"):
            if name == "DiT-B":
                trainer = make_dit_for_training(setup, precision)
                arrays = [draw_posteriors(trainer, batch, seed=k) for k in range(8)]
            else:
                trainer = make_lvae_for_training(setup, precision)
                arrays = [layouts.draw(k, batch) for k in range(8)]
            curve = [trainer.step(arrays[k % 8], range(batch))["loss"] for k in range(steps)]
            curves[precision] = torch.stack(curve).float().cpu().numpy()
        ratio = curves["bf16"] / curves["fp32"]
        yield Row(
            f"{name}, loss in bfloat16 divided by loss in float32, last {last} of {steps} steps",
            float(curves["bf16"][-last:].mean() / curves["fp32"][-last:].mean()),
            "",
            note=f"single steps {ratio.min():.3f} to {ratio.max():.3f}; batch {batch}",
        )


@torch.no_grad()
def measure_primitives(model: LayoutVAE, arrays: dict[str, torch.Tensor]) -> dict[str, float]:
    """Return the accuracy of the primitives that the model decodes from the latent mean.

    Args:
        model: Layout VAE in evaluation mode.
        arrays: Compact layouts.

    Returns:
        The scores of `models.vae.accuracy.Accuracy`, shares in percent.
    """
    batch = LayoutBatch.from_compact(arrays)
    accuracy = compute_accuracy(pair_primitives(model.decode(model.encode(batch).mean), batch, model.spec))
    return {
        "median centre error (m)": accuracy.median_center_error_m,
        "recall of primitives within 1 m (%)": 100 * accuracy.recall_1m,
        "precision of proposals within 1 m (%)": 100 * accuracy.precision_1m,
        "IoU3D of matched primitives (%)": 100 * accuracy.mean_iou3d,
    }


def find_checkpoint(folder: Path) -> Path | None:
    """Return the newest complete checkpoint under `folder`; the state is written last."""
    found = [path.parent for path in folder.glob("step-*/state.json")]
    return max(found, key=lambda path: int(path.name.removeprefix("step-")), default=None)


def save_checkpoint(trainer: Trainer, folder: Path) -> None:
    """Save a checkpoint under `folder`, then remove all others."""
    new = folder / f"step-{trainer.steps_done}"
    if not (new / "state.json").exists():
        trainer.save(new)
    for path in folder.glob("step-*"):
        if path != new:
            shutil.rmtree(path)


def run_learn(setup: Setup) -> Iterator[Row]:
    """Train a layout VAE on the scenes, from the last checkpoint.

    The training ends a minute before LEARN_SECONDS, so there is time to save and to score.
    """
    preset = setup.find_lvae_preset("kitti360")
    layouts, steps, batch = Layouts(setup, setup.make_spec(preset)), setup.choose(setup.steps, 4), setup.choose(32, 2)
    first_batch = layouts.draw(0, min(64, len(layouts)))
    trainer = make_lvae_for_training(setup, "auto", steps, first_batch, compiled=not setup.tiny)
    folder = setup.output / "learn"
    if checkpoint := find_checkpoint(folder):
        trainer.load(checkpoint)
    first, started, curve = trainer.steps_done, time.monotonic(), []
    saved = started
    while trainer.steps_done < steps and time.monotonic() - started < LEARN_SECONDS - 60:
        found = trainer.step(layouts.draw(trainer.steps_done, batch), range(batch))
        if trainer.steps_done % 50 == 0 or trainer.steps_done == steps:
            curve.append((trainer.steps_done, {name: float(value) for name, value in found.items()}))
            print(f"  step {trainer.steps_done}: loss {curve[-1][1]['loss']:.4f}", flush=True)
        if time.monotonic() - saved > SAVE_SECONDS:
            save_checkpoint(trainer, folder)
            saved = time.monotonic()
    save_checkpoint(trainer, folder)
    trainer.model.save_pretrained(folder / "model")
    with (folder / "curve.jsonl").open("a") as stream:
        for step, values in curve:
            stream.write(json.dumps({"step": step} | values) + "\n")
    seconds = time.monotonic() - started
    done = trainer.steps_done - first
    for name in ("loss", "center", "cholesky", "existence", "occupancy"):
        if curve:
            yield Row(f"learn, {name} after {trainer.steps_done} steps", curve[-1][1][name], "")
    trainer.model.eval()
    held_out = slice(len(layouts), None)
    for kind, scenes in (("held out", held_out), ("training scenes", slice(0, layouts.num_held_out))):
        with trainer.run_uncompiled():
            found = measure_primitives(cast(LayoutVAE, trainer.model), layouts.select(scenes))
        for name, value in found.items():
            yield Row(f"learn, {kind}, {name} after {trainer.steps_done} steps", value, "")
    if done:
        yield Row(
            "learn, scenes per second",
            done * batch / seconds,
            "scenes/s",
            note=f"steps {first} to {trainer.steps_done}, with compilation and checkpoints",
        )


# -------------------------------------------------------------------------------------------------------- results

SECTIONS: dict[str, Callable[[Setup], Iterator[Row]]] = {
    "latency": run_latency,
    "throughput": run_throughput,
    "train_dit": run_train_dit,
    "train_lvae": run_train_lvae,
    "precision": run_precision,
    "learn": run_learn,
}


def describe_device(device: torch.device) -> str:
    """Return device, driver, versions and commit in one line."""
    name = platform.processor() or platform.machine()
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        name = f"{torch.cuda.get_device_name(device)}, {total / 2**30:.0f} GiB ({free / 2**30:.0f} free)"
        with suppress(OSError, subprocess.CalledProcessError):
            command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
            name += f", driver {subprocess.check_output(command, text=True).split()[0]}"
    commit = os.environ.get("COMMIT", "")
    if not commit:
        with suppress(OSError, subprocess.CalledProcessError):
            command = ["git", "-C", str(ROOT), "rev-parse", "--short=10", "HEAD"]
            commit = subprocess.check_output(command, text=True, stderr=subprocess.DEVNULL).strip()
    return f"{name}, torch {torch.__version__}, CUDA {torch.version.cuda}, Python {platform.python_version()}, {commit}"


def format_table(results: dict) -> str:
    """Return the rows of all sections as a Markdown table."""
    lines = ["| quantity | value | target | paper | conditions |", "|---" * 5 + "|"]
    for section in results.values():
        for row in section["rows"]:
            value = f"{row['value']:.4g} {row['unit']}".strip()
            lines.append(f"| {row['quantity']} | {value} | {row['target']} | {row['paper']} | {row['note']} |")
    machines = sorted({section["machine"] for section in results.values()})
    return "\n".join([*lines, "", *machines, ""])


def run_sections(setup: Setup, names: list[str]) -> int:
    """Run sections and replace their rows in the results of earlier runs; return the number of failed sections."""
    path, failed = setup.output / "gpu.json", 0
    setup.output.mkdir(parents=True, exist_ok=True)
    results = json.loads(path.read_text()) if path.exists() else {}
    for name in names:
        started, rows, is_complete, stopped = time.monotonic(), [], False, False
        print(f"{name}:", flush=True)
        try:
            for row in SECTIONS[name](setup):
                if setup.tiny:
                    row = replace(row, quantity=f"tiny {row.quantity}", target="", paper="")
                rows.append(vars(row))
                print(f"  {row.quantity}: {row.value:.4g} {row.unit} {row.note}", flush=True)
            is_complete = True
        except Exception as error:  # The other sections still run.
            failed += 1
            if not isinstance(error, ValueError):
                traceback.print_exc()
            print(f"error: {name}: {error}", file=sys.stderr, flush=True)
        except KeyboardInterrupt:
            stopped = True
            print(f"{name}: stopped", file=sys.stderr, flush=True)
        if rows and (is_complete or name not in results):  # Complete rows of an earlier run are kept.
            seconds = time.monotonic() - started
            results[name] = {"machine": describe_device(setup.device), "seconds": round(seconds, 1), "rows": rows}
        results = {section: results[section] for section in SECTIONS if section in results}
        path.write_text(json.dumps(results, indent=1) + "\n")
        (setup.output / "gpu.md").write_text(format_table(results))
        if stopped:
            return failed + 1
    return failed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("gpu"), help="directory of results (default: gpu)")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS), help="sections to run")
    parser.add_argument("--scenes", default="", help="file of --write-scenes (default: random layouts)")
    parser.add_argument("--steps", type=int, default=20_000, help="training steps of learn (default: 20000)")
    parser.add_argument("--peak-tflops", type=float, default=989.0, help="peak in bfloat16 (default: 989, H100)")
    parser.add_argument("--cpu", action="store_true", help="rehearse with tiny networks on the CPU")
    parser.add_argument("--write-scenes", type=Path, metavar="FILE", help="write town scenes to this file, and exit")
    parser.add_argument("--num-scenes", type=int, default=256, help="number of scenes to write (default: 256)")
    options = parser.parse_args()
    if options.write_scenes:
        if not options.write_scenes.absolute().parent.is_dir():
            print(f"error: --write-scenes {options.write_scenes}: its directory does not exist", file=sys.stderr)
            return 2
        write_scenes(options.write_scenes, options.num_scenes)
        return 0
    if not options.cpu and not torch.cuda.is_available():
        print("error: torch finds no GPU; check nvidia-smi and the driver, or rehearse with --cpu", file=sys.stderr)
        return 2
    device = torch.device("cpu" if options.cpu else "cuda")
    try:
        require_bf16(device)
    except ValueError as error:
        print(f"error: {str(error).partition(';')[0]}; use another GPU", file=sys.stderr)
        return 2
    if options.scenes:
        load_scenes(options.scenes)
    elif "learn" in options.only and not options.cpu:
        raise ValueError(
            "learn needs --scenes FILE; make it with --write-scenes FILE, or name the other sections with --only"
        )
    setup = Setup(device, options.cpu, options.peak_tflops, options.output, options.scenes, options.steps)
    failed = run_sections(setup, options.only)
    print(f"results: {options.output}/gpu.md")
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
