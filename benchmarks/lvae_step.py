"""Measure the parts of a training step of the layout VAE, and compare the step with a plain version.

The comparison uses the paper's DETR decoder. With a cell decoder, the plain version would pad to thousands of
proposals.

    python benchmarks/lvae_step.py                   # town, batch 8, and kitti360, batch 2; several minutes
    python benchmarks/lvae_step.py --presets town
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

import plain
import torch
import tyro
from common import describe_machine, format_ratios, spread
from matching import make_town_batch

from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.presets import LVAE_PRESETS, find_preset
from models.vae import losses
from models.vae.config import override_options
from models.vae.losses import compute_lvae_loss


@dataclass(frozen=True)
class Config:
    presets: tuple[str, ...] = ("town", "kitti360")
    rounds: int = 5
    threads: int = 2


def time_step(model: LayoutVAE, optimiser: torch.optim.Optimizer, batch, noise: torch.Tensor) -> dict[str, float]:
    """Run one step, and return the time of each part in seconds and the loss."""
    clock = time.perf_counter()
    seconds = {}

    def lap(name: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[name] = seconds.get(name, 0.0) + now - clock
        clock = now

    output, posterior = model(batch, noise)
    lap("forward")
    matching = losses.match_primitives

    def match_timed(*args):
        lap("losses")
        result = matching(*args)
        lap("matching")
        return result

    losses.match_primitives = match_timed
    try:
        total = compute_lvae_loss(output, posterior, batch, model.spec).total
    finally:
        losses.match_primitives = matching
    lap("losses")
    optimiser.zero_grad(set_to_none=True)
    total.backward()
    lap("backward")
    optimiser.step()
    lap("optimiser")
    return seconds | {"loss": float(total)}


def main(config: Config) -> None:
    torch.set_num_threads(config.threads)
    print(describe_machine(), f"{config.threads} threads")
    for name in config.presets:
        row = find_preset(LVAE_PRESETS, name)
        batch_size = 2 if name == "kitti360" else row.batch_size
        spec = LayoutSpec().with_resolution(row.raster_px)
        batch = make_town_batch(spec, max(4, batch_size))
        batch = type(batch)(*(getattr(batch, field)[:batch_size] for field in batch.__dataclass_fields__))
        models = {}
        for way, decoder in (("as it is", row.model.objects.decoder), ("ours", "detr"), ("plain", "detr")):
            torch.manual_seed(0)
            changes = {"objects": {"decoder": decoder}, "local_frame": False}  # DETR has no local frame.
            model = LayoutVAE(layout=spec.to_dict(), **override_options(row.architecture(), changes))
            model.init_from_data(batch)
            models[way] = (model, torch.optim.AdamW(model.parameters(), 1e-5))
        noise = torch.randn(batch_size, *models["ours"][0].latent_shape)
        rounds: dict[str, list[dict[str, float]]] = {way: [] for way in models}
        for k in range(config.rounds + 1):
            for way, trained in models.items():
                with plain.replace_ours() if way == "plain" else contextlib.nullcontext():
                    rounds[way].append(time_step(*trained, batch, noise))
            assert abs(rounds["ours"][k]["loss"] / rounds["plain"][k]["loss"] - 1) < 1e-3, "not the same objective"
        rounds = {way: found[1:] for way, found in rounds.items()}  # the first round warms up
        total = {
            way: [sum(v for part, v in r.items() if part != "loss") for r in found] for way, found in rounds.items()
        }
        for way, found in rounds.items():
            parts = ", ".join(
                f"{part} {spread([r[part] for r in found], 1e3, 0)}" for part in found[0] if part != "loss"
            )
            print(f"{name}, batch {batch_size}, {way}: step {spread(total[way], 1e3, 0)} ms: {parts}")
        print(f"{name}: time of the plain version / time of ours = {format_ratios(total['plain'], total['ours'], 2)}")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
