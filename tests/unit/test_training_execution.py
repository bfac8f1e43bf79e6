"""Tests of trainings whose networks are compiled."""

import pytest
from helpers import ROOT, run_command

# The backend "aot_eager" traces and differentiates as the default backend does, but generates no code.
COMPILE = """
import sys
from functools import partialmethod
import torch
from torch._dynamo.utils import counters
torch.nn.Module.compile = partialmethod(torch.nn.Module.compile, backend="aot_eager")
sys.path.insert(0, "benchmarks")
import gpu
from pathlib import Path
from models.dit import DiT
from models.lvae import LayoutVAE
from models.presets import DIT_PRESETS, LVAE_PRESETS
from models.training import (
    ExecutionConfig, make_dit_settings, make_dit_trainer, make_lvae_settings, make_lvae_trainer
)

setup = gpu.Setup(torch.device("cpu"), True, 989.0, Path("unused"), "", 1)
preset, dit_preset = LVAE_PRESETS["smoke"], DIT_PRESETS["smoke"]
layouts = gpu.Layouts(setup, setup.make_spec(preset))

def train(kind, compiled):
    execution = ExecutionConfig(precision="fp32", compile=compiled)
    torch.manual_seed(0)
    if kind == "dit":
        model = DiT(channels=8, size=8, width=32, depth=3, heads=2)
        settings = make_dit_settings(dit_preset)
        trainer = make_dit_trainer(model, settings, 0.1, setup.device, execution=execution)
        batches = [gpu.draw_posteriors(trainer, 4, seed) for seed in range(3)]
    else:
        model = LayoutVAE(layout=setup.make_spec(preset).to_dict(), **preset.architecture())
        trainer = make_lvae_trainer(model, make_lvae_settings(preset), 1e-6, setup.device, execution=execution)
        batches = [layouts.draw(step, 2) for step in range(3)]
        for step, batch in enumerate(batches):
            batch["real"][:, 100 - 30 * step :] = False
    names = list(trainer.model.state_dict())
    losses = [float(trainer.step(batch, range(len(next(iter(batch.values())))))["loss"]) for batch in batches]
    few = {name: value[:1] for name, value in batches[0].items()}
    with trainer.run_uncompiled(), torch.no_grad():
        trainer.model.eval()
        trainer.loss(trainer.model, few, [torch.Generator()])
    return torch.tensor(losses), names

kind = sys.argv[1]
(plain, names), (compiled, same_names) = train(kind, False), train(kind, True)
close = torch.allclose(plain, compiled, rtol=1e-4)
print(close and len(set(plain.tolist())) == 3 and names == same_names, counters["stats"]["unique_graphs"])
"""


@pytest.mark.parametrize(("kind", "graphs"), [("dit", (1,)), pytest.param("lvae", (4,), marks=pytest.mark.slow)])
def test_compiled_training_has_equal_losses(kind, graphs):
    """Runs in a process without checks of annotations, which cannot be compiled.

    The blocks of the transformer share one graph. The layout VAE has one graph for each of its four kinds of parts, and
    may have one more for other numbers of primitives. A smaller batch of the validation is not compiled.
    """
    done = run_command("-c", COMPILE, kind, PYTHONPATH=f"{ROOT}:{ROOT / 'tests'}")
    assert done.stdout.split() in [["True", str(count)] for count in graphs], done.stderr[-3000:]
