"""Ground branch of the layout VAE: diffusers' convolutional VAE on raster maps (paper, supplement B.2)."""

from __future__ import annotations

from diffusers.models.autoencoders.vae import Decoder, Encoder
from jaxtyping import Float
from torch import Tensor, nn


class GroundEncoder(nn.Module):
    """Raster maps [H; B] -> mean and log-variance of the ground latent, stacked along the channels.

    Blocks of fold x fold pixels first become channels (1 in the paper: no folding); then each entry of `channels` but
    the last halves the resolution once: four entries give the paper's factor 8.
    """

    def __init__(
        self, num_classes: int, latent_channels: int, channels: tuple[int, ...], norm_groups: int, fold: int
    ) -> None:
        super().__init__()
        self.fold = nn.PixelUnshuffle(fold)
        self.net = Encoder(
            in_channels=2 * num_classes * fold**2,
            out_channels=latent_channels,
            down_block_types=("DownEncoderBlock2D",) * len(channels),
            block_out_channels=channels,
            layers_per_block=1,
            norm_num_groups=norm_groups,
            double_z=True,
        )

    def forward(self, maps: Float[Tensor, "batch maps rows cols"]) -> Float[Tensor, "batch moments h w"]:
        return self.net(self.fold(maps * 2 - 1))


class GroundDecoder(nn.Module):
    """Ground latent -> normalised heights and occupancy logits, stacked along the channels."""

    def __init__(
        self, num_classes: int, latent_channels: int, channels: tuple[int, ...], norm_groups: int, fold: int
    ) -> None:
        super().__init__()
        self.net = Decoder(
            in_channels=latent_channels,
            out_channels=2 * num_classes * fold**2,
            up_block_types=("UpDecoderBlock2D",) * len(channels),
            block_out_channels=channels,
            layers_per_block=1,
            norm_num_groups=norm_groups,
        )
        self.unfold = nn.PixelShuffle(fold)

    def forward(self, latent: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch maps rows cols"]:
        return self.unfold(self.net(latent))

    def start_at(self, mean: Float[Tensor, maps]) -> None:
        """Set the last bias: a channel of the output starts at its mean."""
        self.net.conv_out.bias.copy_(mean.repeat_interleave(self.unfold.upscale_factor**2))
