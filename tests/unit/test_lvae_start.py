"""Tests of continuing the training of a layout VAE on a dataset with other slots."""

from dataclasses import replace

import pytest
import torch
from helpers import random_scene, small_spec

from jobs.implementation.train_lvae import load_start
from models.lvae import LayoutVAE
from models.presets import LVAE_PRESETS
from models.tensors import make_layout_batch
from models.vae.config import override_options

OPTIONS = override_options(
    LVAE_PRESETS["smoke"].architecture(), {"objects": {"decoder": "cells", "min_proposals_per_cell": 3}}
)


def test_cell_decoder_continues_with_other_slots(tmp_path):
    few, more = small_spec(), replace(small_spec(), slots=tuple(count + 2 for count in small_spec().slots))
    torch.manual_seed(0)
    lvae = LayoutVAE(few.to_dict(), **OPTIONS)
    lvae.save_pretrained(tmp_path)
    resized = load_start(str(tmp_path), OPTIONS, more)
    assert resized.spec == more
    scene = random_scene(0)
    with torch.no_grad():
        before, after = (model.encode(make_layout_batch([scene], model.spec)).mean for model in (lvae, resized))
        found, again = (model.decode(before) for model in (lvae, resized))
    assert torch.allclose(before, after, atol=1e-5)
    assert torch.equal(found.features, again.features) and found.proposals == again.proposals


def test_start_names_slots_that_need_other_networks(tmp_path):
    torch.manual_seed(0)
    LayoutVAE(small_spec().to_dict(), **OPTIONS).save_pretrained(tmp_path)
    many = replace(small_spec(), slots=(200, *small_spec().slots[1:]))
    with pytest.raises(ValueError, match=r"the decoder has another size than with .* preprocess the dataset with the"):
        load_start(str(tmp_path), OPTIONS, many)
    with pytest.raises(ValueError, match=r"its grid is .* use the preset with which it was trained"):
        load_start(str(tmp_path), OPTIONS, small_spec(64))
    fewer = replace(small_spec(), slots=tuple(count - 1 for count in small_spec().slots), surface="surface")
    assert load_start(str(tmp_path), OPTIONS, fewer).spec == small_spec()  # The layout of the weights.
