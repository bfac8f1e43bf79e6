"""Ground decoder whose classes are level sets: smooth borders at any resolution.

The convolutional decoder returns spline coefficients of the signed distance from the border of each class and of the
height at nodes. Uniform cubic B-splines evaluate both, which are therefore twice continuously differentiable. A class
covers the points with a positive signed distance. Its occupancy logit is the signed distance times a learned slope. The
paper has one logit per pixel instead.

The network computes the nodes of one latent cell together, so the coefficients of heights alternate a little from node
to node. Without averaging, slopes at the borders of cells are a third larger than in the middle of cells. The
coefficients of heights are therefore averaged over neighbouring nodes.
"""

from __future__ import annotations

from functools import lru_cache
from typing import cast

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from models.base import apply_in_float32
from models.vae.config import GroundConfig
from models.vae.convolutional import ConvolutionalDecoder
from models.vae.ground import (
    LOGITS_PER_PX,
    GroundEncoder,
    compute_edge_reach_px,
    compute_linear_autoencoder,
    set_shortcuts,
    split_cells,
)


@lru_cache(maxsize=16)
@torch.inference_mode(False)
def make_spline_matrix(
    num_nodes: int, num_points: int, device: torch.device | str = "cpu", average: bool = False
) -> Float[Tensor, "points nodes"]:
    """Return the matrix that evaluates a uniform cubic B-spline at the centres of pixels.

    The interval is divided into `num_nodes` equal parts with a node at each centre, and into `num_points` pixels.
    Beyond the first and the last node, the coefficients of these nodes are repeated.

    Args:
        num_nodes: Number of nodes, which carry the coefficients.
        num_points: Number of pixels.
        device: Device of the result.
        average: Whether each coefficient is first averaged with its two neighbours, with the weights 1/4, 1/2 and 1/4.
            This removes alternating coefficients.

    Returns:
        Weights of the nodes for each pixel. Each row sums to 1.
    """
    place = (torch.arange(num_points, dtype=torch.float64) + 0.5) * num_nodes / num_points - 0.5
    first = place.floor()
    t = place - first
    weights = torch.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], dim=1) / 6
    nodes = (first.long()[:, None] + torch.arange(-1, 3)).clamp(0, num_nodes - 1)
    matrix = torch.zeros(num_points, num_nodes, dtype=torch.float64).scatter_add_(1, nodes, weights)
    if average:
        node = torch.arange(num_nodes)
        mean = torch.zeros(num_nodes, num_nodes, dtype=torch.float64)
        for offset, weight in ((-1, 0.25), (0, 0.5), (1, 0.25)):
            mean[node, (node + offset).clamp(0, num_nodes - 1)] += weight
        matrix = matrix @ mean
    return matrix.float().to(device)


class LevelSetDecoder(nn.Module):
    """Decode a ground latent to normalised heights, occupancy logits and signed distances.

    Args:
        num_classes: Number of ground classes.
        latent_channels: Number of channels of the latent.
        config: Options of the ground branch.
        shortcut: If True, a linear map of the latent is added to the output of the network (models/vae/ground.py).
    """

    def __init__(self, num_classes: int, latent_channels: int, config: GroundConfig, shortcut: bool) -> None:
        super().__init__()
        self.net = ConvolutionalDecoder(
            latent_channels, 2 * num_classes, tuple(config.channels), config.norm_groups, config.attention
        )
        self.node_px, self.reach_px = config.pixel_unshuffle, compute_edge_reach_px(config.cell_px)
        cell = config.cell_px // self.node_px  # Side of a latent cell in nodes.
        self.shortcut = nn.ConvTranspose2d(latent_channels, 2 * num_classes, cell, stride=cell) if shortcut else None
        self.log_slope = nn.Parameter(torch.full((num_classes, 1, 1), float(self.reach_px)).log())

    def forward(
        self, latent: Float[Tensor, "batch c h w"], raster_px: int | None = None
    ) -> tuple[
        Float[Tensor, "batch ground rows cols"],
        Float[Tensor, "batch ground rows cols"],
        Float[Tensor, "batch ground rows cols"],
    ]:
        """Decode ground latents.

        Args:
            latent: Ground latents.
            raster_px: Number of rows and of columns of the rasters; None: the resolution of the training data.

        Returns:
            Normalised heights, occupancy logits, and signed distances in units of `reach_px` pixels of the training
            data, positive inside the class.
        """
        nodes = self.decode_nodes(latent)
        with torch.autocast(nodes.device.type, enabled=False):
            size, count = nodes.shape[-1], raster_px or nodes.shape[-1] * self.node_px
            points, means = (make_spline_matrix(size, count, nodes.device, average) for average in (False, True))
            height, distance = nodes.float().chunk(2, dim=1)
            height, distance = means @ height @ means.T, points @ distance @ points.T
            return height, self.log_slope.float().exp() * distance, distance

    def decode_nodes(self, latent: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch maps n n"]:
        """Decode ground latents to the coefficients of the splines.

        Args:
            latent: Ground latents.

        Returns:
            Coefficients of heights and of signed distances, concatenated along the channel axis.
        """
        nodes = self.net(latent)
        return nodes if self.shortcut is None else nodes + apply_in_float32(self.shortcut, latent)


@torch.no_grad()
def init_level_sets(
    encoder: GroundEncoder,
    decoder: LevelSetDecoder,
    height: Float[Tensor, "batch ground rows cols"],
    occupied: Float[Tensor, "batch ground rows cols"],
) -> None:
    """Initialise the outputs to their means and the shortcuts to the best linear autoencoder of the smooth maps.

    The slope of the logits is the one with the smallest occupancy loss. See `set_shortcuts` for the other values.

    Args:
        encoder: Encoder to initialise.
        decoder: Decoder to initialise.
        height: Normalised heights of training scenes.
        occupied: Masks of training scenes, 0 or 1.
    """
    smooth = encoder.compute_shortcut_input(height, occupied)
    if encoder.shortcut is None or decoder.shortcut is None:
        cast(Tensor, decoder.net.conv_out.bias).copy_(smooth.mean(dim=(0, 2, 3)))
        distance = smooth.mean(dim=(0, 2, 3))[None, height.shape[1] :, None, None].expand(occupied.shape)
    else:
        cell, latent = encoder.shortcut.stride[0], encoder.shortcut.out_channels
        autoencoder = compute_linear_autoencoder(split_cells(smooth, cell), latent)
        set_shortcuts(encoder, decoder.shortcut, decoder.net, autoencoder)
        nodes = decoder.shortcut(F.pad(encoder.shortcut(smooth), (0,) * 5 + (decoder.shortcut.in_channels - latent,)))
        points = make_spline_matrix(nodes.shape[-1], occupied.shape[-1], nodes.device)
        distance = (points @ nodes @ points.T).chunk(2, dim=1)[1]
    error = {
        logit: F.binary_cross_entropy_with_logits(logit * decoder.reach_px * distance, occupied)
        for logit in LOGITS_PER_PX
    }
    decoder.log_slope.fill_(min(error, key=lambda logit: float(error[logit])) * decoder.reach_px).log_()
