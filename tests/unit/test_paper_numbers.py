"""Test that the paper's presets and constants have the numbers of docs/reference/paper.md."""

import ast
import importlib.util
import re
from dataclasses import asdict, replace
from typing import Any

import pytest
import torch
from helpers import ROOT

from models.composition.block_grid import choose_arrangement
from models.dit import DiT
from models.layout import LayoutSpec
from models.lvae import LayoutVAE
from models.presets import DIT_PRESETS, LVAE_PRESETS
from models.training import count_flops

ROW = re.compile(r"^\| ([^|]+) \| ([^|]+) \| `([^`]+)` \| ([^|]+) \|$", re.M)
PAGE = (ROOT / "docs/reference/paper.md").read_text()
NUMBERS = PAGE.partition("\n## Numbers\n")[2]
ROWS = ROW.findall(NUMBERS)


def make_lvae() -> LayoutVAE:
    return LayoutVAE(layout=LayoutSpec().to_dict(), **LVAE_PRESETS["kitti360"].architecture())


def count_parameters(model: LayoutVAE) -> float:
    return round(sum(p.numel() for p in model.parameters()) / 1e6, 1)


def list_names() -> dict[str, Any]:
    names: dict[str, Any] = {"lvae": LVAE_PRESETS["kitti360"], "dit": DIT_PRESETS["kitti360"]}
    names |= {"dit_l": DIT_PRESETS["kitti360-l"], "dit_xl": DIT_PRESETS["kitti360-xl"]}
    names |= {function.__name__: function for function in (make_lvae, count_parameters, choose_arrangement, len, tuple)}
    for module in set(re.findall(r"\b((?:jobs|models|pipelines)(?:\.[a-z_]+)+)\.[A-Z]", str(ROWS))):
        importlib.import_module(module)
    packages = {name: importlib.import_module(name) for name in ("jobs", "models", "pipelines")}
    return names | packages


def test_page_lists_the_paper():
    assert len(ROWS) > 50
    assert NUMBERS.count("\n| ") - NUMBERS.count("\n| quantity |") == len(ROWS)  # Each row has a field.


@pytest.mark.parametrize(("quantity", "value", "field", "place"), ROWS, ids=[row[0] for row in ROWS])
def test_field_has_the_number_of_the_paper(quantity, value, field, place):
    assert eval(field, list_names()) == ast.literal_eval(value), f"{quantity}: {place}"


def test_av2_has_the_networks_of_the_paper():
    assert replace(LVAE_PRESETS["av2"], source="kitti360") == LVAE_PRESETS["kitti360"]
    assert replace(DIT_PRESETS["av2"], lvae="kitti360") == DIT_PRESETS["kitti360"]


@pytest.mark.parametrize("name", ["kitti360-l", "kitti360-xl"])
def test_larger_transformers_differ_only_in_size_and_steps(name):
    base, larger = DIT_PRESETS["kitti360"], DIT_PRESETS[name]
    assert replace(larger, model=base.model, steps=base.steps) == base
    assert replace(larger.model, depth=12, width=768, heads=12) == base.model


def count_training_flops(name: str) -> float:
    """Return the operations of all steps, from models with one and with two blocks."""
    preset, latents, number = DIT_PRESETS[name], torch.zeros(1, 64, 32, 32), torch.zeros(1, dtype=torch.long)
    models = [DiT(**asdict(preset.model) | {"depth": depth}) for depth in (1, 2)]
    with torch.no_grad():
        first, second = (count_flops(lambda model=model: model(latents, number, number)) for model in models)
    return preset.steps * (first + (preset.model.depth - 1) * (second - first))


def test_all_transformers_have_the_same_total_compute():
    base = count_training_flops("kitti360")
    for name in ("kitti360-l", "kitti360-xl"):
        assert count_training_flops(name) == pytest.approx(base, rel=1e-3)


def test_page_links_each_mechanism_to_a_line_of_code():
    path = ROOT / "docs/hooks.py"
    loaded = importlib.util.spec_from_file_location("hooks", path)
    hooks = importlib.util.module_from_spec(loaded)
    loaded.loader.exec_module(hooks)
    names = re.findall(r"\[`((?:models|pipelines)[\w.]+)`\]\[\]", PAGE.partition("## Deviations")[0])
    assert len(names) > 35
    for name in names:
        path, line = hooks.find_line(name).split(":")
        text = (ROOT / path).read_text().splitlines()[int(line) - 1]
        assert line == "1" or re.match(rf"\s*(class|def) {name.rpartition('.')[2]}\b", text), name
    with pytest.raises(ValueError, match=r"models/lvae\.py has no LayoutGAN"):
        hooks.find_line("models.lvae.LayoutGAN")
