"""Options of the two branches of the layout VAE. This module does not import torch, because presets.py uses it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

from models.options import Choice, Flag, Integer, Rule, Sequential, check_entries, show_value

Branches = Literal["both", "ground", "objects"]
DECODERS = ("detr", "cells")
QUERIES = ("learned", "anchors", "conditional")
POSITION_UNITS = ("map", "cell")
LOSS_UNITS = ("normalised", "metres", "cells")

# Rules of the entries of a stored config.
WIDTH = Integer(1, 2**16)
RULES: dict[str, Rule] = {
    "latent_channels": Integer(1, 4096),
    "shortcut": Flag(),
    "split_latent": Flag(),
    "branches": Choice(get_args(Branches)),
    "local_frame": Flag(),
}
GROUND_RULES: dict[str, Rule] = {
    "channels": Sequential(WIDTH, 1, 12),
    "norm_groups": WIDTH,
    "pixel_unshuffle": Integer(1, 256),
    "attention": Flag(),
    "level_sets": Flag(),
}
OBJECT_RULES: dict[str, Rule] = {
    "width": WIDTH,
    "layers": Integer(1, 1000),
    "heads": Integer(1, 1024),
    "hidden": WIDTH,
    "head_hidden": WIDTH,
    "decoder": Choice(DECODERS),
    "min_proposals_per_cell": Integer(0, 1000),
    "loss_unit": Choice(LOSS_UNITS),
    "queries": Choice(QUERIES),
    "learned_content": Flag(),
    "position_unit": Choice(POSITION_UNITS),
    "auxiliary_losses": Flag(),
    "denoising_groups": Integer(0, 100),
    "order_in_cell": Flag(),
}


@dataclass(frozen=True)
class GroundConfig:
    """Options of the ground branch: a convolutional autoencoder of rasters (models/vae/ground.py).

    Attributes:
        channels: Number of channels of each block. Each block except the last halves the resolution. With four blocks,
            a latent cell has a side of 8 pixels, as in the paper.
        norm_groups: Number of groups of each group normalisation.
        pixel_unshuffle: Factor of the pixel unshuffle before the first convolution; 1: no pixel unshuffle, as in the
            paper.
        attention: If True, the middle blocks of encoder and decoder have self-attention over all cells, as in the
            paper.
        level_sets: If True, the decoder returns signed distances and heights at nodes (one per pixel after the pixel
            unshuffle) with cubic B-splines between the nodes (models/vae/level_sets.py). Otherwise, it returns one
            logit and one height per pixel, as in the paper.
    """

    channels: tuple[int, ...] = (64, 128, 256, 512)
    norm_groups: int = 32
    pixel_unshuffle: int = 1
    attention: bool = True
    level_sets: bool = False

    @property
    def cell_px(self) -> int:
        """Side of a latent cell in pixels."""
        return self.pixel_unshuffle * 2 ** (len(self.channels) - 1)


@dataclass(frozen=True)
class ObjectConfig:
    """Options of the object branch, which has a transformer encoder (models/vae/objects.py) and one of two decoders.

    Attributes:
        width: Width of the transformer tokens.
        layers: Number of transformer layers.
        heads: Number of attention heads.
        hidden: Width of the feed-forward networks of the transformer.
        head_hidden: Width of the output networks.
        decoder: "detr", as in the paper, or "cells" (models/vae/cell_decoder.py).
        min_proposals_per_cell: Minimum number of proposals per category and cell (only for the decoder "cells").
        loss_unit: Unit of distances in matching and losses: "normalised" coordinates, as in the paper, "metres" or
            "cells" of the latent grid. With metres and cells, the unit of Cholesky parameters is the square root of it.
        queries: Only for the decoder "detr", as are the following options: "learned" embeddings, as in the paper,
            "anchors" or "conditional" (models/vae/detr_decoder.py).
        learned_content: If True, the contents of queries start from learned values instead of zeros.
        position_unit: Unit of the sine position embeddings: "map" or "cell" (`detr_decoder.embed_positions`).
        auxiliary_losses: If True, each layer of the decoder has a loss in training.
        denoising_groups: Number of groups of denoising queries in training; 0: none. Each layer has a centre and a
            Cholesky loss for them, without an existence loss.
        order_in_cell: If True, the encoder knows the order of the primitives within each cell, and the value of a cell
            is the sum of their features. Otherwise, it is the mean, as in the paper.
    """

    width: int = 512
    layers: int = 6
    heads: int = 8
    hidden: int = 1024
    head_hidden: int = 1024
    decoder: str = "detr"
    min_proposals_per_cell: int = 1
    loss_unit: str = "normalised"
    queries: str = "learned"
    learned_content: bool = False
    position_unit: str = "map"
    auxiliary_losses: bool = False
    denoising_groups: int = 0
    order_in_cell: bool = False


@dataclass(frozen=True)
class LayoutVAEConfig:
    """Architecture of a `LayoutVAE` without its layout.

    Attributes:
        latent_channels: Number of latent channels per branch.
        ground: Options of the ground branch.
        objects: Options of the object branch.
        shortcut: If True, add linear maps in parallel to the ground networks and a small network in parallel to the
            object encoder. The paper has no shortcuts.
        split_latent: If True, each decoder reads only its half of the latent channels, as in the paper. If False, both
            decoders read all channels.
        branches: "both". An ablation model with only one branch uses "ground" or "objects".
        local_frame: If True, object latents hold the yaw of primitives relative to the streets and their height
            relative to the ground (models/vae/local_frame.py). Otherwise, they hold both in the scene frame, as in the
            paper.
    """

    latent_channels: int = 32
    ground: GroundConfig = GroundConfig()
    objects: ObjectConfig = ObjectConfig()
    shortcut: bool = False
    split_latent: bool = True
    branches: Branches = "both"
    local_frame: bool = False


# Maps the flat option names of versions before 0.2 to a branch and the current name.
_FLAT_NAMES = {
    **{name: ("ground", name) for name in ("channels", "norm_groups", "attention")},
    "fold": ("ground", "pixel_unshuffle"),
    **{name: ("objects", name) for name in ("width", "layers", "heads", "hidden", "head_hidden", "decoder")},
    "least_per_cell": ("objects", "min_proposals_per_cell"),
}


def nest_flat_options(config: dict[str, Any]) -> dict[str, Any]:
    """Convert flat options to options that are nested under `ground` and `objects`.

    Args:
        config: Stored config. Flat configs were written by versions before 0.2. Nested configs are returned unchanged.

    Returns:
        Options of `LayoutVAE`; the options of each branch are one dictionary.

    Raises:
        ValueError: The config holds both flat and nested options of a branch.
    """
    nested = {name: value for name, value in config.items() if name not in _FLAT_NAMES}
    for name, value in config.items():
        if name in _FLAT_NAMES:
            branch, renamed = _FLAT_NAMES[name]
            if branch in config:
                raise ValueError(f"{branch} and {name} exclude each other: {name} is an option of earlier versions")
            nested.setdefault(branch, {})[renamed] = value
    objects = nested.get("objects")
    if isinstance(objects, Mapping) and objects.get("decoder") == "cells" and "loss_unit" not in objects:
        nested["objects"] = {**objects, "loss_unit": "cells"}  # Versions before 0.3 had no option.
    return nested


def parse_options(config: dict[str, Any]) -> dict[str, Any]:
    """Check the options of `LayoutVAE`, and convert those of the branches to dataclasses.

    Args:
        config: Options; those of a branch are a dictionary or a dataclass. The layout is not checked.

    Returns:
        Keyword arguments, with one dataclass of options per branch.

    Raises:
        ValueError: An option is unknown or has an invalid value.
    """
    check_entries(config, RULES, others=True)
    kinds: dict[str, Any] = {"ground": GroundConfig, "objects": ObjectConfig}
    parsed = {}
    for name, rules in (("ground", GROUND_RULES), ("objects", OBJECT_RULES)):
        parsed[name] = config.get(name, kinds[name]())
        if not isinstance(parsed[name], kinds[name]):
            check_entries(parsed[name], rules, name)
            entries = {k: tuple(v) if isinstance(v, list) else v for k, v in parsed[name].items()}
            parsed[name] = kinds[name](**entries)
    ground, objects = parsed["ground"], parsed["objects"]
    if any(count % ground.norm_groups for count in ground.channels):
        raise ValueError(
            f"ground.channels is {show_value(ground.channels)}, expected multiples of norm_groups {ground.norm_groups}"
        )
    step = 4 if objects.decoder == "detr" else 1  # The position embeddings of DETR have sine and cosine of two axes.
    if objects.width % objects.heads or objects.width % step:
        raise ValueError(
            f"objects.width is {objects.width}, expected a multiple of heads {objects.heads} and of {step}"
        )
    return config | parsed


def override_options(options: Mapping[str, Any], changes: Mapping[str, object]) -> dict[str, Any]:
    """Return keyword arguments of `LayoutVAE` after changing some of them.

    Args:
        options: Keyword arguments of `LayoutVAE`.
        changes: New values by name. For a branch, the value can be a mapping that replaces only some fields.

    Returns:
        The changed keyword arguments.
    """
    return dict(options) | {
        name: replace(options[name], **value) if isinstance(value, Mapping) else value
        for name, value in changes.items()
    }
