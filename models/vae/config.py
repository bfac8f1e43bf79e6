"""Options of the two branches of the layout VAE. This module does not import torch, because presets.py uses it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

Branches = Literal["both", "ground", "objects"]


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
    """Options of the object branch, which has a transformer encoder (models/vae/objects.py) and one of two decoders.

    Attributes:
        width: Width of the transformer tokens.
        layers: Number of transformer layers.
        heads: Number of attention heads.
        hidden: Width of the feed-forward networks of the transformer.
        head_hidden: Width of the output networks.
        decoder: "detr", as in the paper, or "cells" (models/vae/cell_decoder.py).
        min_proposals_per_cell: Minimum number of proposals per category and cell (only for the decoder "cells").
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
    """

    latent_channels: int = 32
    ground: GroundConfig = GroundConfig()
    objects: ObjectConfig = ObjectConfig()
    shortcut: bool = False
    split_latent: bool = True
    branches: Branches = "both"


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
        Keyword arguments, with one dataclass of options per branch.

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
                raise ValueError(f"LayoutVAE: cannot convert {name} to {kind.__name__}: {error}") from error
    return options


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
