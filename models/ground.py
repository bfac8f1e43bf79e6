"""Ground branch of the layout VAE: diffusers' convolutional VAE on raster maps (paper, supplement B.2)."""

from __future__ import annotations

import torch
from diffusers.models.autoencoders.vae import Decoder, Encoder
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

LOGIT_GAIN = 6.0  # occupancy 0 and 1 of the linear start become logits of -3 and 3


class GroundEncoder(nn.Module):
    """Raster maps [H; B] -> mean and log-variance of the ground latent, stacked along the channels.

    Blocks of fold x fold pixels first become channels (1 in the paper: no folding); then each entry of `channels` but
    the last halves the resolution once: four entries give the paper's factor 8. `attention` is the paper's, over all cells in
    the middle of the network. With `shortcut`, the mean is the
    network's plus a linear map of the cell's pixels (`start_at`). Not in the paper.
    """

    def __init__(
        self,
        num_classes: int,
        latent_channels: int,
        channels: tuple[int, ...],
        norm_groups: int,
        fold: int,
        attention: bool,
        shortcut: bool,
    ) -> None:
        super().__init__()
        self.fold = nn.PixelUnshuffle(fold)
        self.net = Encoder(
            in_channels=2 * num_classes * fold**2,
            out_channels=latent_channels,
            down_block_types=("DownEncoderBlock2D",) * len(channels),
            block_out_channels=channels,
            layers_per_block=1,
            mid_block_add_attention=attention,
            norm_num_groups=norm_groups,
            double_z=True,
        )
        cell = fold * 2 ** (len(channels) - 1)
        self.shortcut = nn.Conv2d(2 * num_classes, latent_channels, cell, stride=cell) if shortcut else None

    def forward(self, maps: Float[Tensor, "batch maps rows cols"]) -> Float[Tensor, "batch moments h w"]:
        moments = self.net(self.fold(maps * 2 - 1))
        if self.shortcut is None:
            return moments
        mean, logvar = moments.chunk(2, dim=1)
        return torch.cat([mean + self.shortcut(maps), logvar], dim=1)


class GroundDecoder(nn.Module):
    """Ground latent -> normalised heights and occupancy logits, stacked along the channels."""

    def __init__(
        self,
        num_classes: int,
        latent_channels: int,
        channels: tuple[int, ...],
        norm_groups: int,
        fold: int,
        attention: bool,
        shortcut: bool,
    ) -> None:
        super().__init__()
        self.net = Decoder(
            in_channels=latent_channels,
            out_channels=2 * num_classes * fold**2,
            up_block_types=("UpDecoderBlock2D",) * len(channels),
            block_out_channels=channels,
            layers_per_block=1,
            mid_block_add_attention=attention,
            norm_num_groups=norm_groups,
        )
        self.unfold = nn.PixelShuffle(fold)
        cell = fold * 2 ** (len(channels) - 1)
        self.shortcut = nn.ConvTranspose2d(latent_channels, 2 * num_classes, cell, stride=cell) if shortcut else None

    def forward(self, latent: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch maps rows cols"]:
        maps = self.unfold(self.net(latent))
        return maps if self.shortcut is None else maps + self.shortcut(latent)


@torch.no_grad()
def start_at(
    encoder: GroundEncoder,
    decoder: GroundDecoder,
    height: Float[Tensor, "batch ground rows cols"],
    occupied: Float[Tensor, "batch ground rows cols"],
) -> None:
    """Start where linear algebra can: outputs at their means; with shortcuts, at the best linear autoencoder.

    The shortcuts become the closed form of reduced-rank regression (Izenman 1975) from a cell's pixels to what its
    decoder should say, and the networks start at zero beside them. On the town it starts at a ground IoU of 0.9,
    which the networks alone have not reached after ten minutes on two cores.
    """
    count = occupied.sum(dim=(0, 2, 3)).clamp(min=1)
    mean_height = (height * occupied).sum(dim=(0, 2, 3)) / count
    mean_logit = occupied.mean(dim=(0, 2, 3)).clamp(0.01, 0.99).logit()
    bias = torch.cat([mean_height, mean_logit]).repeat_interleave(decoder.unfold.upscale_factor**2)
    decoder.net.conv_out.bias.copy_(bias)
    if encoder.shortcut is None:
        return
    cell = encoder.shortcut.stride[0]
    given = _cells(torch.cat([height, occupied], dim=1), cell)
    wanted = _cells(torch.cat([_filled(height, occupied, cell), occupied], dim=1), cell)
    given_mean, wanted_mean = given.mean(dim=0), wanted.mean(dim=0)
    latent, maps = encoder.shortcut.out_channels, 2 * occupied.shape[1]
    encode, decode = reduced_rank_regression(given - given_mean, wanted - wanted_mean, latent)
    gain = torch.tensor([1.0, LOGIT_GAIN], dtype=decode.dtype).repeat_interleave(decode.shape[1] // 2)
    centred = wanted_mean - torch.tensor([0.0, 0.5], dtype=decode.dtype).repeat_interleave(decode.shape[1] // 2)
    encoder.shortcut.weight.copy_(encode.T.reshape(latent, maps, cell, cell))
    encoder.shortcut.bias.copy_(-given_mean @ encode)
    decoder.shortcut.weight.copy_((decode * gain).reshape(latent, maps, cell, cell))
    decoder.shortcut.bias.copy_((centred * gain).reshape(maps, -1).mean(dim=1))
    encoder.net.conv_out.weight[:latent].zero_()
    decoder.net.conv_out.weight.zero_()
    decoder.net.conv_out.bias.zero_()


def _cells(maps: Float[Tensor, "batch maps rows cols"], cell: int) -> Float[Tensor, "cells pixels"]:
    """The pixels of each latent cell, (map, row, col) in C order, float64."""
    pixels = F.pixel_unshuffle(maps, cell)
    return pixels.permute(0, 2, 3, 1).reshape(-1, pixels.shape[1]).double()


def _filled(
    height: Float[Tensor, "batch ground rows cols"], occupied: Float[Tensor, "batch ground rows cols"], cell: int
) -> Float[Tensor, "batch ground rows cols"]:
    """Heights, and where nothing is occupied and so any height will do, the cell's or the scene's mean."""
    total, count = (F.avg_pool2d(v.sum(dim=1, keepdim=True), cell) for v in (height * occupied, occupied))
    scene = (height * occupied).sum(dim=(1, 2, 3)) / occupied.sum(dim=(1, 2, 3)).clamp(min=1)
    mean = torch.where(count > 0, total / count.clamp(min=1e-6), scene[:, None, None, None])
    mean = mean.repeat_interleave(cell, dim=2).repeat_interleave(cell, dim=3)
    return torch.where(occupied > 0, height, mean)


def reduced_rank_regression(
    given: Float[Tensor, "n p"], wanted: Float[Tensor, "n q"], rank: int
) -> tuple[Float[Tensor, "p rank"], Float[Tensor, "rank q"]]:
    """encode and decode that minimise |given encode decode - wanted|^2, codes of unit variance. Centred inputs."""
    covariance = given.T @ given / len(given)
    ridge = 1e-4 * torch.eye(len(covariance), dtype=given.dtype)
    regression = torch.linalg.solve(covariance + ridge, given.T @ wanted / len(given))
    _, directions = torch.linalg.eigh(regression.T @ covariance @ regression)
    directions = directions[:, -rank:]
    encode = regression @ directions
    scale = torch.einsum("pr,pq,qr->r", encode, covariance, encode).sqrt().clamp(min=1e-6)
    return encode / scale, (directions * scale).T
