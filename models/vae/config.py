"""Options of the layout VAE's two branches. This module does not import torch, because presets.py uses it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

Branches = Literal["both", "ground", "objects"]


@dataclass(frozen=True)
class GroundConfig:
    """Options of the ground branch: a convolutional autoencoder of rasters (models/vae/ground.py).

    Attributes:
        channels: Number of channels of each block. All blocks but the last halve the resolution. With four blocks, a
            latent cell has a side of 8 pixels, as in the paper.
        norm_groups: Number of groups of each group normalisation.
        pixel_unshuffle: Side of the pixel blocks that pixel unshuffle converts to channels before the first
            convolution. The value 1 means no pixel unshuffle, as in the paper.
        attention: Self-attention over all cells in the middle block of encoder and decoder, as in the paper.
    """

    channels: tuple[int, ...] = (64, 128, 256, 512)
    norm_groups: int = 32
    pixel_unshuffle: int = 1
    attention: bool = True

    @property
    def cell_px(self) -> int:
        """Side of a latent cell in pixels."""
        return self.pixel_unshuffle * 2 ** (len(self.channels) - 1)


@dataclass(frozen=True)
class ObjectConfig:
    """Options of the object branch: a transformer encoder (models/vae/objects.py) and one of two decoders.

    Attributes:
        width: Width of the transformer tokens.
        layers: Number of transformer layers.
        heads: Number of attention heads.
        hidden: Width of the feed-forward networks of the transformer.
        head_hidden: Width of the output networks.
        decoder: "detr", the paper's decoder, or "cells" (models/vae/cell_decoder.py).
        min_proposals_per_cell: Minimum number of proposals per category and cell, for the decoder "cells".
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
    """Architecture of a `LayoutVAE`, except its layout.

    Attributes:
        latent_channels: Number of latent channels per branch.
        ground: Options of the ground branch.
        objects: Options of the object branch.
        shortcut: Add linear maps parallel to the ground networks and a small network parallel to the object encoder.
            The paper has no shortcuts.
        split_latent: Each decoder reads its own half of the latent channels, as in the paper. If False, both decoders
            read all channels.
        branches: "both", or the only branch of an ablation model.
    """

    latent_channels: int = 32
    ground: GroundConfig = GroundConfig()
    objects: ObjectConfig = ObjectConfig()
    shortcut: bool = False
    split_latent: bool = True
    branches: Branches = "both"


# Config entries of versions before 0.2: flat name -> branch and current name.
_FLAT_NAMES = {
    **{name: ("ground", name) for name in ("channels", "norm_groups", "attention")},
    "fold": ("ground", "pixel_unshuffle"),
    **{name: ("objects", name) for name in ("width", "layers", "heads", "hidden", "head_hidden", "decoder")},
    "least_per_cell": ("objects", "min_proposals_per_cell"),
}


def nest_flat_options(config: dict[str, Any]) -> dict[str, Any]:
    """Nest the options of the branches under `ground` and `objects`.

    Args:
        config: Stored config. Versions before 0.2 wrote flat configs; nested configs are accepted, too.

    Returns:
        Options of `LayoutVAE`, with one dictionary per branch.
    """
    nested: dict[str, Any] = {}
    for name, value in config.items():
        if name in _FLAT_NAMES:
            branch, renamed = _FLAT_NAMES[name]
            nested.setdefault(branch, {})[renamed] = value
        else:
            nested[name] = value
    return nested


def parse_options(config: dict[str, Any]) -> dict[str, Any]:
    """Convert a stored config, nested or flat, to keyword arguments of `LayoutVAE`.

    Args:
        config: Stored config.

    Returns:
        Keyword arguments with one dataclass per branch.

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
    """Return keyword arguments of `LayoutVAE` with changes.

    Args:
        options: Keyword arguments of `LayoutVAE`.
        changes: New values by name. A mapping replaces fields of the dataclass of a branch.

    Returns:
        The changed keyword arguments.
    """
    return dict(options) | {
        name: replace(options[name], **value) if isinstance(value, Mapping) else value
        for name, value in changes.items()
    }
