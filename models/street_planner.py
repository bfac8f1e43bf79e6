"""Network that plans streets: a U-Net for the signed distances of street plans (composition/street_plan.py).

The U-Net is `UNet2DModel` of the library `diffusers`. A transformer like `models.dit.DiT` learns more slowly to connect
streets across patches (docs/experiments/cities.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from models.base import register_computed_buffers, register_to_config
from models.diffusion_model import DiffusionModel, make_noise_shares, parse_schedule, require_num_labels
from models.labels import LABELS
from models.limits import require_within
from models.options import FINITE, LARGE, Choice, Integer, Number, Rule, Sequential, check_entries
from models.sampling.diffusion import PAPER_SCHEDULE, Denoiser, Diffusion
from models.sampling.known_regions import NUM_STREET_UNIFORM, make_street_masks

PIXEL_M = 4.0  # Side of a pixel of a street plan.
SCENE_M = 64.0  # Side of the scenes that street plans continue.
CHANNELS = 2  # Distance to the border of the roads, and to the border of the paved area.
LABEL_KIND = "partial"  # Kind of label: densities of vegetation and vehicles, or any.
MAX_LEVELS = 8
GROUPS, HEAD_WIDTH = 8, 32  # Groups of the group normalisation, and channels per attention head.
RULES: dict[str, Rule] = {
    "size": Integer(2, 4096),
    "block_px": Integer(1, 16),
    "widths": Sequential(Integer(HEAD_WIDTH, 2**12), 1, MAX_LEVELS),
    "layers": Integer(1, 16),
    "label": Choice((LABEL_KIND,)),
    "num_labels": Integer(1, 10_000),
    "shift": Sequential(FINITE, CHANNELS, CHANNELS),
    "scale": Sequential(Number(1e-6, LARGE), CHANNELS, CHANNELS),
    "prediction": Choice(("v_prediction",)),
}


def measure_border_distances(rows: int, cols: int) -> np.ndarray:
    """Return the distance of the pixels of a street plan to the border of the plan.

    Args:
        rows: Number of rows.
        cols: Number of columns.

    Returns:
        (rows, cols) distances of the centres (m).
    """
    row, col = ((0.5 + np.minimum(np.arange(n), np.arange(n)[::-1])) * PIXEL_M for n in (rows, cols))
    return np.minimum(row[:, None], col[None, :])


class StreetPlanner(DiffusionModel):
    """Predict the noise in street plans (b, 2, size, size), conditioned on timestep, label and a known part.

    Args:
        size: Number of pixels per side.
        block_px: Side of the blocks of pixels that become channels of the U-Net. It must divide `size`.
        widths: Number of channels of each level of the U-Net, at least 32. All levels but the first have attention.
        layers: Number of residual layers per level.
        label: Kind of label, a key of `models.labels.LABELS`.
        num_labels: Number of labels. The index `num_labels` is the null label of classifier-free guidance.
        shift: One value per channel, subtracted from distances before diffusion (m).
        scale: One divisor per channel, applied after the shift (m).
        schedule: Noise schedule of the training.
        prediction: Output of the network, "v_prediction" (`models.dit.DiT`).

    Raises:
        ValueError: `block_px` does not divide `size`, or the size is too small for the number of levels.
    """

    border_m: Tensor

    @register_to_config
    def __init__(
        self,
        size: int = 64,
        block_px: int = 2,
        widths: Sequence[int] = (64, 128, 192),
        layers: int = 1,
        label: str = LABEL_KIND,
        num_labels: int = len(LABELS[LABEL_KIND]),
        shift: Sequence[float] = (0.0, 0.0),
        scale: Sequence[float] = (1.0, 1.0),
        schedule: Diffusion = PAPER_SCHEDULE,
        prediction: str = "v_prediction",
    ) -> None:
        from diffusers.models.unets.unet_2d import UNet2DModel  # The import needs seconds.

        super().__init__()
        if size % (block_px * 2 ** (len(widths) - 1)):
            raise ValueError(
                f"StreetPlanner: size is {size}, expected a multiple of {block_px * 2 ** (len(widths) - 1)}, for"
                f" block_px {block_px} and {len(widths)} widths"
            )
        channels, last = CHANNELS * block_px**2, len(widths) - 1
        self.unet = UNet2DModel(
            sample_size=size // block_px,
            in_channels=3 * channels,
            out_channels=channels,
            layers_per_block=layers,
            block_out_channels=tuple(widths),
            down_block_types=("DownBlock2D", *("AttnDownBlock2D",) * last),
            up_block_types=(*("AttnUpBlock2D",) * last, "UpBlock2D"),
            attention_head_dim=HEAD_WIDTH,
            norm_num_groups=GROUPS,
            num_class_embeds=num_labels + 1,
        )
        self._schedule, self._block_px, self._size = schedule, block_px, size
        register_computed_buffers(self)

    def compute_buffers(self) -> dict[str, Tensor]:
        """Return the precomputed buffers.

        Returns:
            noise_shares: weights of the latent and of v in the noise, per timestep. border_m: (size, size) distances of
            pixels to the border of a scene in the middle; 0 outside (m).
        """
        size, side = self._size, min(round(SCENE_M / PIXEL_M), self._size)
        border_m = torch.zeros(size, size)
        inside = slice((size - side) // 2, (size + side) // 2)
        border_m[inside, inside] = torch.from_numpy(measure_border_distances(side, side)).float()
        return {"noise_shares": make_noise_shares(self._schedule), "border_m": border_m}

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Shape of a street plan."""
        return CHANNELS, self._size, self._size

    @property
    def num_mask_uniform(self) -> int:
        """Number of random numbers per sample of `make_known_masks`."""
        return NUM_STREET_UNIFORM

    def make_known_masks(self, uniform: Tensor, values: Tensor) -> Tensor:
        """Make masks of random known parts for the training (`models.sampling.known_regions.make_street_masks`).

        Args:
            uniform: (b, num_mask_uniform) random numbers between 0 and 1.
            values: (b, 2, size, size) distances (m).

        Returns:
            Masks with the shape of `values`; 1 marks values to generate, 0 marks known values.
        """
        return make_street_masks(uniform, values, self.border_m)

    @classmethod
    def parse_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Check all entries, and convert the noise schedule to a Diffusion.

        Args:
            config: Value of every constructor argument.

        Returns:
            Keyword arguments of the constructor.

        Raises:
            ValueError: An entry has an invalid value, or exceeds the limit of training timesteps.
        """
        check_entries(config, RULES, others=True)
        require_num_labels(config)
        if wrong := [width for width in config["widths"] if width % HEAD_WIDTH]:
            raise ValueError(f"widths contains {wrong[0]}, expected multiples of {HEAD_WIDTH}")
        require_within("model_buffers", config["size"] ** 2 * max(config["widths"]), "size of the street plans")
        return config | {"schedule": parse_schedule(config["schedule"])}

    def forward(
        self, latent: Float[Tensor, "batch 6 h w"], timestep: Int[Tensor, " batch"], label: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch 2 h w"]:
        """Predict the noise in normalised distances.

        Args:
            latent: Noisy distances with a known part (`models.sampling.diffusion.join_known`).
            timestep: Timesteps.
            label: Class indices.

        Returns:
            Predicted noise.
        """
        blocks = F.pixel_unshuffle(latent, self._block_px)
        velocity = F.pixel_shuffle(self.unet(blocks, timestep, class_labels=label).sample, self._block_px)
        of_latent, of_velocity = self.noise_shares[timestep][:, :, None, None, None].unbind(1)
        return of_latent * latent[:, :CHANNELS] + of_velocity * velocity

    def make_denoiser(self) -> Denoiser:
        """Return the network as a denoiser without gradients."""
        return torch.no_grad()(self.forward)
