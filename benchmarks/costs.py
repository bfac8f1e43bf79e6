"""Estimate GPU hours, CPU hours, requests, bytes and money of each stage of four projects.

    python benchmarks/costs.py
    python benchmarks/costs.py --gpu-hour 1.2 --utilisation 0.4 --scenes 10000

The projects are KITTI-360, 1,000 logs of Argoverse 2, 60,000 generated scenes with their evaluation, and a city. CPU
time, requests and bytes per unit are measured (cost_rates.py). GPU time is calculated: the script counts the
floating-point operations of the paper's networks and divides them by the peak of a GPU times an assumed utilisation.
Prices are options. The prices by default are rounded list prices; they differ between providers.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import torch
import tyro
from cost_rates import RATES
from matching import make_town_batch

from models.dit import DiT
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.presets import DIT_PRESETS, LVAE_PRESETS
from models.sampling.repaint import NUM_INFERENCE_STEPS, repaint_transitions
from models.training import count_flops
from models.vae.losses import compute_lvae_loss

KITTI360_SCENES = 61_913 + 1_233  # Paper, Sec. 4.1.
SWEEPS_PER_LOG = 156.5  # Argoverse 2: 313 sweeps in two logs (docs/experiments/preprocessing_and_geometry.md).
BLOCK_STEP_M = 32.0  # A block of 64 m x 64 m overlaps its neighbours by half.
BYTES_PER_WEIGHT = 20  # A checkpoint has weights, EMA, two moments of AdamW, and the model, in float32.
CHECKPOINTS = 2  # Number of checkpoints that a run keeps.
PAPER_GPU_HOURS = {"train LVAE": 72, "train DiT": 288}  # Supplement B.2, B.3: 3 days on one and on four A100.


@dataclass(frozen=True)
class Config:
    gpu_tflops: float = 312.0
    """Peak of a GPU for matrix products in bfloat16, in TFLOP/s (A100: 312, H100: 990)."""
    utilisation: float = 0.05
    """Assumed share of this peak. The times of the paper correspond to 0.10 (layout VAE) and 0.04 (DiT-B)."""
    gpu_hour: float = 2.0
    """Price of a GPU for an hour, with its share of the machine."""
    cpu_hour: float = 0.04
    """Price of a CPU core for an hour."""
    writes_1000: float = 0.005
    """Price of 1,000 requests that write objects."""
    reads_1000: float = 0.0004
    """Price of 1,000 requests that read objects."""
    gigabyte_month: float = 0.023
    """Price of a gigabyte of object storage for a month."""
    logs: int = 1000
    """Number of logs of Argoverse 2."""
    scenes: int = 60_000
    """Number of scenes to generate and to evaluate."""
    city_km2: float = 10.0
    """Area of the city (km2)."""
    num_inference_steps: int = NUM_INFERENCE_STEPS
    """Denoising steps per scene; the paper uses 250."""


@dataclass(frozen=True)
class Work:
    """FLOP counts of the paper's networks for one sample (kitti360, DiT-B)."""

    lvae_step: float
    encode: float
    decode: float
    dit_step: float
    denoise: float
    lvae_weights: int
    dit_weights: int


@dataclass(frozen=True)
class Row:
    """Use of one stage."""

    project: str
    stage: str
    units: str
    gpu_hours: float
    cpu_hours: float
    writes: float
    reads: float
    gigabytes: float

    def price(self, config: Config) -> float:
        """Return the price of the stage and of one month of its storage."""
        requests = self.writes * config.writes_1000 + self.reads * config.reads_1000
        hours = self.gpu_hours * config.gpu_hour + self.cpu_hours * config.cpu_hour
        return hours + requests / 1000 + self.gigabytes * config.gigabyte_month


def count_work() -> Work:
    """Count the operations of the presets kitti360 (LVAE and DiT-B) for one sample."""
    spec = LayoutSpec()
    batch = make_town_batch(spec, 4)
    batch = type(batch)(*(getattr(batch, name)[:1] for name in batch.__dataclass_fields__))
    lvae = LayoutVAE(layout=spec.to_dict(), **LVAE_PRESETS["kitti360"].architecture())
    lvae.init_from_data(batch)
    noise = torch.randn(1, *lvae.latent_shape)

    def train_lvae() -> None:
        output, posterior = lvae(batch, noise)
        compute_lvae_loss(output, posterior, batch, lvae.spec).total.backward()

    step = count_flops(train_lvae)
    with torch.no_grad():
        posterior = lvae.encode(batch)
        encode, decode = count_flops(lambda: lvae.encode(batch)), count_flops(lambda: lvae.decode(posterior.mean))
    channels, size = lvae.latent_shape[0], lvae.latent_shape[-1]
    dit_step, denoise = count_dit_flops("kitti360", channels, size)
    with torch.device("meta"):
        dit = DiT(channels=channels, size=size, **DIT_PRESETS["kitti360"].architecture())
    weights = [sum(p.numel() for p in model.parameters()) for model in (lvae, dit)]
    return Work(step, encode, decode, dit_step, denoise, *weights)


def count_dit_flops(preset: str, channels: int, size: int) -> tuple[float, float]:
    """Count the operations of a training step and of a denoising step of a DiT, for one latent."""
    dit = DiT(channels=channels, size=size, **DIT_PRESETS[preset].architecture())
    latent, time, label = torch.randn(1, channels, size, size), torch.tensor([500]), torch.tensor([0])
    step = count_flops(lambda: dit(latent, time, label).square().mean().backward())
    with torch.no_grad():
        return step, count_flops(lambda: dit(latent, time, label))


def estimate(config: Config, work: Work, rates: dict[str, dict[str, float]]) -> Iterator[Row]:
    """Yield the use of each stage of each project."""

    def hours(operations: float) -> float:
        return operations / (config.gpu_tflops * 1e12 * config.utilisation) / 3600

    def measured(project: str, stage: str, count: float, unit: str, gpu_hours: float = 0.0) -> Row:
        """Return a stage with measured rates. The measured CPU time contains the networks, so a GPU replaces it."""
        rate = rates[stage]
        cpu_hours = 0.0 if gpu_hours else count * rate["cpu_s"] / 3600
        stored = count * rate["stored_bytes"] / 1e9
        label = f"{count:,.0f} {unit}"
        return Row(project, stage, label, gpu_hours, cpu_hours, count * rate["writes"], count * rate["reads"], stored)

    def training(project: str, name: str, preset, operations: float, weights: int, scenes: float) -> Row:
        samples = preset.steps * preset.batch_size
        reads = samples * rates["encode"]["reads"]  # Encoding and training read the same shards.
        stored = CHECKPOINTS * BYTES_PER_WEIGHT * weights / 1e9
        units = f"{preset.steps:,} steps of {preset.batch_size}, {samples / scenes:.0f} epochs"
        return Row(project, name, units, hours(samples * operations), 0.0, 0.0, reads, stored)

    for project, scenes, preset in (
        ("KITTI-360", KITTI360_SCENES, "kitti360"),
        (f"AV2, {config.logs:,} logs", config.logs * SWEEPS_PER_LOG, "av2"),
    ):
        yield measured(project, "preprocess", scenes, "scenes")
        lvae, dit = LVAE_PRESETS[preset], DIT_PRESETS[preset]
        yield training(project, "train LVAE", lvae, work.lvae_step, work.lvae_weights, scenes)
        yield measured(project, "encode", scenes, "scenes", hours(scenes * work.encode))
        yield training(project, "train DiT", dit, work.dit_step, work.dit_weights, scenes)
    project = f"{config.scenes:,} scenes"
    sampling = config.scenes * (config.num_inference_steps * work.denoise + work.decode)
    yield measured(project, "sample", config.scenes, "scenes", hours(sampling))
    yield measured(project, "evaluate", config.scenes, "scenes per side")
    project, blocks = f"city, {config.city_km2:g} km2", config.city_km2 * 1e6 / BLOCK_STEP_M**2
    passes = sum(b < a for a, b in repaint_transitions(config.num_inference_steps))
    block = passes * work.denoise + work.encode + work.decode
    yield measured(project, "outpaint", blocks, "blocks, RePaint", hours(blocks * block))


def find_paper_hours(row: Row) -> int:
    """Return the GPU hours of the paper for a stage, or 0; the paper states only those of KITTI-360."""
    return PAPER_GPU_HOURS.get(row.stage, 0) if row.project == "KITTI-360" else 0


def format_table(rows: list[Row], config: Config) -> str:
    """Return the rows as a Markdown table."""
    lines = ["| project | stage | units | GPU h | CPU h | writes / reads | stored GB | price |"]
    lines.append("|---" * 8 + "|")
    for row in rows:
        gpu = f"{row.gpu_hours:,.2f}" + (f" (paper: {p})" if (p := find_paper_hours(row)) else "")
        lines.append(
            f"| {row.project} | {row.stage} | {row.units} | {gpu if row.gpu_hours else '0'} | {row.cpu_hours:,.1f} |"
            f" {row.writes:,.0f} / {row.reads:,.0f} | {row.gigabytes:,.2f} | {row.price(config):,.2f} |"
        )
    return "\n".join(lines)


def main(config: Config) -> int:
    if not RATES.exists():
        print(f"error: {RATES} does not exist; run python benchmarks/cost_rates.py first", file=sys.stderr)
        return 2
    record, work = json.loads(RATES.read_text()), count_work()
    print(f"rates: {record['command']}; {record['machine']}")
    values = (work.lvae_step, work.encode, work.decode, work.dit_step, work.denoise)
    names = ("training step of the LVAE", "encode", "decode", "training step of DiT-B", "denoising step of DiT-B")
    print("GFLOP per sample: " + ", ".join(f"{n} {v / 1e9:.1f}" for n, v in zip(names, values, strict=True)))
    rows = list(estimate(config, work, record["per_unit"]))
    print(format_table(rows, config))
    print(f"total price: {sum(row.price(config) for row in rows):,.0f}")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))
