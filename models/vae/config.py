"""Options of the layout VAE's two branches; no torch, so that presets can be read without it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

Branches = Literal["both", "ground", "objects"]


@dataclass(frozen=True)
class GroundConfig:
    """Ground branch: a convolutional autoencoder of raster maps (models/vae/ground.py).

    Args:
        channels: Width of each block; all blocks but the last halve the resolution. Four blocks give the paper's
            factor 8.
        norm_groups: Groups of each group normalisation.
        pixel_unshuffle: Side of the pixel blocks that become channels first; 1 in the paper, none.
        attention: Self-attention over all cells in the middle of both networks, as in the paper.
    """

    channels: tuple[int, ...] = (64, 128, 256, 512)
    norm_groups: int = 32
    pixel_unshuffle: int = 1
    attention: bool = True

    @property
    def cell_px(self) -> int:
        """Side of a latent cell in raster pixels."""
        return self.pixel_unshuffle * 2 ** (len(self.channels) - 1)


@dataclass(frozen=True)
class ObjectConfig:
    """Object branch: a transformer encoder (models/vae/objects.py) and one of two decoders.

    Args:
        width, layers, heads, hidden: Of the transformer; `hidden` is the width of its feed-forward networks.
        head_hidden: Width of the output networks.
        decoder: "detr", the paper's, or "cells" (models/vae/cell_decoder.py).
        min_proposals_per_cell: With "cells", the least number of proposals of each category in each cell.
    """

    width: int = 512
    layers: int = 6
    heads: int = 8
    hidden: int = 1024
    head_hidden: int = 1024
    decoder: str = "detr"
    min_proposals_per_cell: int = 1


@dataclass(frozen=True)
class LayoutVAEConfig:
    """Architecture of a `LayoutVAE` apart from its layout.

    Args:
        latent_channels: Channels of the latent per branch.
        ground, objects: Options of the branches.
        shortcut: Linear maps past the ground networks and a small network past the object encoder; not in the paper.
        split_latent: Each decoder reads its own half of the latent's channels, as in the paper; without, both read all.
        branches: The branches that exist. An ablation of the paper has one of them.
    """

    latent_channels: int = 32
    ground: GroundConfig = GroundConfig()
    objects: ObjectConfig = ObjectConfig()
    shortcut: bool = False
    split_latent: bool = True
    branches: Branches = "both"


# Entries of configs that versions before 0.2 wrote, flat -> branch and name.
_FLAT_NAMES = {
    **{name: ("ground", name) for name in ("channels", "norm_groups", "attention")},
    "fold": ("ground", "pixel_unshuffle"),
    **{name: ("objects", name) for name in ("width", "layers", "heads", "hidden", "head_hidden", "decoder")},
    "least_per_cell": ("objects", "min_proposals_per_cell"),
}


def nest_flat_options(config: dict[str, Any]) -> dict[str, Any]:
    """Options of `LayoutVAE` with those of its branches nested, from a flat config or one that is nested already."""
    nested: dict[str, Any] = {}
    for name, value in config.items():
        if name in _FLAT_NAMES:
            branch, renamed = _FLAT_NAMES[name]
            nested.setdefault(branch, {})[renamed] = value
        else:
            nested[name] = value
    return nested


def parse_options(config: dict[str, Any]) -> dict[str, Any]:
    """Keyword arguments of `LayoutVAE` from a stored config, nested or flat.

    Raises:
        ValueError: An option of a branch is unknown.
    """
    options = nest_flat_options(config)
    kinds: dict[str, Any] = {"ground": GroundConfig, "objects": ObjectConfig}
    for name, kind in kinds.items():
        if isinstance(entries := options.get(name), Mapping):
            try:
                options[name] = kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in entries.items()})
            except TypeError as error:
                raise ValueError(f"LayoutVAE: {name} is not a {kind.__name__}: {error}") from error
    return options


def override_options(options: Mapping[str, Any], changes: Mapping[str, object]) -> dict[str, Any]:
    """Keyword arguments of `LayoutVAE` with changes; a mapping changes entries of a branch's dataclass."""
    return dict(options) | {
        name: replace(options[name], **value) if isinstance(value, Mapping) else value
        for name, value in changes.items()
    }
