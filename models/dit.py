"""The original Diffusion Transformer (Peebles & Xie, 2023) on latent grids (paper, supplement B.3).

The network consists of adaLN-Zero blocks that share one timestep embedding and one label embedding. The class
`DiTTransformer2DModel` of the library `diffusers` has separate timestep and label embeddings in every block. This
library class is therefore 8 % larger than the class in this module. `DiTTransformer2DModel` also drops labels
independently in each block, so the unconditional branch of classifier-free guidance is never trained. In this module,
each sample has one embedding and one dropout mask for the whole network.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, cast, get_args

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Real
from torch import Tensor, nn

from models.base import apply_in_float32, register_computed_buffers, register_to_config
from models.diffusion_model import DiffusionModel, make_noise_shares, parse_schedule, require_num_labels
from models.labels import LABELS
from models.layout import LayoutSpec
from models.limits import require_within
from models.options import FINITE, LARGE, Choice, Flag, Integer, Number, Rule, Sequential, check_entries
from models.sampling.diffusion import PAPER_SCHEDULE, Denoiser, Diffusion
from models.sampling.known_regions import NUM_UNIFORM, make_training_masks

FREQUENCIES = 256
Prediction = Literal["epsilon", "v_prediction"]

MAX_CHANNELS, MAX_LABELS = 4096, 10_000
# Rules of the entries of a stored config. `layout` and `schedule` are objects with rules of their own.
RULES: dict[str, Rule] = {
    "channels": Integer(1, MAX_CHANNELS),
    "size": Integer(1, 4096),
    "patch": Integer(1, 256),
    "width": Integer(4, 2**16),
    "depth": Integer(1, 1000),
    "heads": Integer(1, 1024),
    "label": Choice(tuple(LABELS)),
    "num_labels": Integer(1, MAX_LABELS),
    "shift": Sequential(FINITE, 1, MAX_CHANNELS),
    "scale": Sequential(Number(1e-6, LARGE), 1, MAX_CHANNELS),
    "prediction": Choice(get_args(Prediction)),
    "inpainting": Flag(),
}


def embed_timesteps(timestep: Real[Tensor, " batch"], width: int = FREQUENCIES) -> Float[Tensor, "batch {width}"]:
    """Compute the sinusoidal embedding of timesteps: cosines, then sines.

    Args:
        timestep: Timesteps.
        width: Number of features, even.

    Returns:
        Embeddings.
    """
    half = width // 2
    frequency = torch.exp(-math.log(10_000) * torch.arange(half, device=timestep.device, dtype=torch.float32) / half)
    angle = timestep.float()[:, None] * frequency
    return torch.cat([angle.cos(), angle.sin()], dim=-1)


def make_sincos_positions(rows: int, width: int) -> Float[Tensor, "tokens d"]:
    """Return the fixed 2D sine-cosine position embeddings of a square token grid.

    Args:
        rows: Number of rows and of columns.
        width: Number of channels; the first half encodes the column, the second half the row.

    Returns:
        Position embeddings of the tokens in row-major order.
    """

    def axis(position: Tensor) -> Tensor:
        frequency = 10_000 ** (-torch.arange(width // 4, dtype=torch.float64) / (width // 4))
        angle = position.flatten()[:, None] * frequency
        return torch.cat([angle.sin(), angle.cos()], dim=1)

    row, col = torch.meshgrid(torch.arange(rows), torch.arange(rows), indexing="ij")
    return torch.cat([axis(col), axis(row)], dim=1).float()


def modulate(x: Float[Tensor, "batch n d"], shift: Tensor, scale: Tensor) -> Float[Tensor, "batch n d"]:
    """Compute (1 + scale) x + shift.

    Args:
        x: Tokens.
        shift: (batch, d) shift per channel.
        scale: (batch, d) scale per channel.

    Returns:
        Modulated tokens.
    """
    return torch.addcmul(shift[:, None], x, (1 + scale)[:, None])


class DiTBlock(nn.Module):
    """Self-attention and MLP, each modulated and gated by the condition (adaLN-Zero)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp_in, self.mlp_out = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)
        self.modulation = nn.Linear(width, 6 * width)

    def forward(
        self, x: Float[Tensor, "batch n d"], modulation: Float[Tensor, "batch 6*d"], perturb: bool = False
    ) -> Float[Tensor, "batch n d"]:
        """Apply the block.

        Args:
            x: Tokens.
            modulation: Shifts, scales and gates, which `self.modulation` computes from the condition.
            perturb: Whether each token attends only to itself, as perturbed-attention guidance needs.

        Returns:
            Tokens of the same shape.
        """
        shift1, scale1, gate1, shift2, scale2, gate2 = modulation.chunk(6, dim=1)
        width = x.shape[-1:]
        y = modulate(F.layer_norm(x, width, eps=1e-6), shift1, scale1)
        q, k, v = self.qkv(y).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)  # q, k, v: (b, heads, n, dh).
        attended = v if perturb else F.scaled_dot_product_attention(q, k, v)
        y = self.out(attended.transpose(1, 2).flatten(2))
        x = torch.addcmul(x, gate1[:, None], y)
        y = modulate(F.layer_norm(x, width, eps=1e-6), shift2, scale2)
        return torch.addcmul(x, gate2[:, None], self.mlp_out(F.gelu(self.mlp_in(y), approximate="tanh")))


class DiT(DiffusionModel):
    """Predict the noise in latents (b, channels, size, size), conditioned on timestep and label.

    Args:
        channels: Number of latent channels.
        size: Number of latent cells per side.
        patch: Side of a patch in latent cells.
        width: Width of the tokens.
        depth: Number of blocks.
        heads: Number of attention heads.
        label: Kind of label, a key of `models.labels.LABELS`.
        num_labels: Number of labels. The index `num_labels` is the null label of classifier-free guidance.
        layout: LayoutSpec of the training scenes as a dictionary, or None.
        shift: One value per channel, subtracted from VAE latents before diffusion. The paper uses no shift.
        scale: One divisor per channel, applied to VAE latents after the shift. The paper uses no scale.
        schedule: Noise schedule of the training. Samplers must use the same schedule.
        prediction: Output of the network. "epsilon" is the noise, as in the paper. "v_prediction" is sqrt(alpha_bar)
            noise - sqrt(1 - alpha_bar) z_0 (Salimans & Ho, 2022), which `forward` converts to the noise. With
            "v_prediction", a small network does not need to pass the noise of its input through all layers.
        inpainting: Whether the network also receives the known part of the clean latent (`join_known`), as the
            inpainting model of Rombach et al. (2022). The paper's network does not; it inpaints with RePaint.

    Raises:
        ValueError: `prediction` is unknown, `patch` does not divide `size`, or `heads` does not divide `width`.
    """

    positions: Tensor

    @register_to_config
    def __init__(
        self,
        channels: int = 64,
        size: int = 32,
        patch: int = 2,
        width: int = 768,
        depth: int = 12,
        heads: int = 12,
        label: str = "vegetation",
        num_labels: int = 3,
        layout: dict | None = None,
        shift: Sequence[float] | None = None,
        scale: Sequence[float] | None = None,
        prediction: Prediction | str = "epsilon",
        schedule: Diffusion = PAPER_SCHEDULE,
        inpainting: bool = False,
    ) -> None:
        super().__init__()
        if prediction not in get_args(Prediction):
            raise ValueError(f"DiT: prediction {prediction!r}, expected one of: {', '.join(get_args(Prediction))}")
        if size % patch or width % heads or width % 4:
            raise ValueError(f"DiT: patch {patch} must divide size {size}, and heads {heads} must divide width {width}")
        self.patch_in = nn.Conv2d(channels, width, patch, stride=patch)
        # Without a bias, an empty known part adds nothing.
        self.known_in = nn.Conv2d(2 * channels, width, patch, stride=patch, bias=False) if inpainting else None
        self.timestep_mlp = nn.Sequential(nn.Linear(FREQUENCIES, width), nn.SiLU(), nn.Linear(width, width))
        self.label_embedding = nn.Embedding(num_labels + 1, width)
        self.blocks = nn.ModuleList(DiTBlock(width, heads) for _ in range(depth))
        self.modulation = nn.Linear(width, 2 * width)
        self.patch_out = nn.Linear(width, patch * patch * channels)
        self._rows, self._schedule = size // patch, schedule
        register_computed_buffers(self)
        self.init_weights()

    def compute_buffers(self) -> dict[str, Tensor]:
        """Return the position embeddings, and per timestep the weights of the latent and of v in the noise."""
        require_within("model_buffers", self._rows**2 * self.patch_out.in_features, "positions of the patches")
        return {
            "positions": make_sincos_positions(self._rows, self.patch_out.in_features),
            "noise_shares": make_noise_shares(self._schedule),
        }

    @classmethod
    def upgrade_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Convert prediction names in a config written by a version before 0.2.

        Args:
            config: Entries of a stored config.

        Returns:
            Entries with the names of this version.
        """
        renamed = {"noise": "epsilon", "velocity": "v_prediction"}
        return config | {name: renamed[config[name]] for name in ("prediction",) if str(config.get(name)) in renamed}

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
        # A model may have no layout and no statistics of its latents.
        absent = [name for name in ("layout", "shift", "scale") if config[name] is None]
        check_entries({name: value for name, value in config.items() if name not in absent}, RULES, others=True)
        for name in ("shift", "scale"):
            if name not in absent and len(config[name]) != config["channels"]:
                raise ValueError(f"{name} has {len(config[name])} entries for {config['channels']} channels")
        require_num_labels(config)
        if "layout" not in absent:
            LayoutSpec.from_dict(config["layout"])
        return config | {"schedule": parse_schedule(config["schedule"])}

    def init_weights(self) -> None:
        """Initialise the weights as in DiT: zeros for the output and every residual branch, Xavier elsewhere."""
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight)
                nn.init.zeros_(module.bias)
        nn.init.xavier_uniform_(self.patch_in.weight.view(len(self.patch_in.weight), -1))
        nn.init.zeros_(cast(Tensor, self.patch_in.bias))
        first, _, second = self.timestep_mlp
        for layer in (self.label_embedding, first, second):
            nn.init.normal_(cast(Tensor, layer.weight), std=0.02)
        if self.known_in is not None:  # At first, the network ignores the known part.
            nn.init.zeros_(self.known_in.weight)
        for layer in (*self.list_modulations(), self.patch_out):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def list_modulations(self) -> list[nn.Linear]:
        """Return the layers that map the condition to modulations: one layer per block, then the output layer."""
        return [*(cast(DiTBlock, block).modulation for block in self.blocks), self.modulation]

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Shape (c, h, w) of a latent."""
        return self.config.channels, self.config.size, self.config.size

    @property
    def num_mask_uniform(self) -> int:
        """Number of random numbers per sample of `make_known_masks`; 0 without `inpainting`."""
        return NUM_UNIFORM if self.config.inpainting else 0

    def make_known_masks(self, uniform: Tensor, values: Tensor) -> Tensor:
        """Make masks of random known parts for the training (`models.sampling.known_regions.make_training_masks`).

        Args:
            uniform: (b, num_mask_uniform) random numbers between 0 and 1.
            values: (b, c, h, w) clean latents; they do not matter.

        Returns:
            Masks with the shape of `values`; 1 marks values to generate, 0 marks known values.
        """
        return make_training_masks(uniform, self.config.channels, self.config.size)

    def condition(self, timestep: Int[Tensor, " batch"], label: Int[Tensor, " batch"]) -> Float[Tensor, "batch d"]:
        """Compute the condition that modulates every block: SiLU(timestep embedding + label embedding).

        Args:
            timestep: Timesteps.
            label: Class indices.

        Returns:
            One vector per sample.
        """
        frequencies = embed_timesteps(timestep).to(self.patch_out.weight.dtype)
        return F.silu(apply_in_float32(self.timestep_mlp, frequencies) + self.label_embedding(label))

    def modulations(self, timestep: Int[Tensor, " batch"], label: Int[Tensor, " batch"]) -> list[Tensor]:
        """Compute the modulations of all layers.

        Args:
            timestep: Timesteps.
            label: Class indices.

        Returns:
            List of tensors. For each block: (b, 6 d) shifts, scales and gates. For the output: (b, 2 d) shift and
            scale. The last tensor (b, 2) contains two factors p and q per sample. The noise is the sum of p times the
            latent and q times the network output.
        """
        condition = self.condition(timestep, label)
        return [*(layer(condition) for layer in self.list_modulations()), self.noise_shares[timestep]]

    def forward(
        self, latent: Float[Tensor, "batch c_in h w"], timestep: Int[Tensor, " batch"], label: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch c h w"]:
        """Predict the noise in latents.

        Args:
            latent: Noisy latents of c channels; or of 3 c channels, with a known part (`join_known`).
            timestep: Timesteps.
            label: Class indices.

        Returns:
            Predicted noise.
        """
        return self.apply_modulations(latent, self.modulations(timestep, label))

    @torch.no_grad()
    def precompute_conditioning(
        self,
        timesteps: Sequence[int],
        labels: Iterable[int],
        pag_scale: float = 0.0,
        pag_drops_label: bool = False,
    ) -> Denoiser:
        """Precompute the modulations for timesteps and labels, and return a faster `forward` for them.

        The modulation layers hold a third of the weights. Without precomputation, each step reads all weights of these
        layers to compute only one or two rows.

        Args:
            timesteps: All timesteps that the denoiser will receive.
            labels: All class indices that the denoiser will receive, including the null label if guidance needs it.
            pag_scale: Scale of perturbed-attention guidance (`apply_modulations`); 0 switches it off.
            pag_drops_label: Whether the perturbed network has the null label from the perturbed block on.

        Returns:
            A denoiser. The denoiser raises IndexError for other timesteps or labels.
        """
        timestep = torch.as_tensor(sorted(set(timesteps)), device=self.positions.device)
        drops = pag_drops_label and pag_scale != 0
        labels = sorted({*labels, self.null_label} if drops else set(labels))
        # Compute each label separately. In a batch, the rounding could depend on the other labels.
        rows = [torch.cat(self.modulations(timestep, torch.full_like(timestep, label)), dim=1) for label in labels]
        table, sizes = torch.cat(rows), [*(layer.out_features for layer in self.list_modulations()), 2]
        row_of = torch.full((int(timestep[-1]) + 1, labels[-1] + 1), len(table), device=timestep.device)
        for k, label in enumerate(labels):
            row_of[timestep, label] = torch.arange(len(timestep), device=timestep.device) + k * len(timestep)

        def select(timestep: Tensor, label: Tensor | int) -> Sequence[Tensor]:
            return table[row_of[timestep, label]].split(sizes, dim=1)

        def denoise(latent: Tensor, timestep: Tensor, label: Tensor) -> Tensor:
            perturbed = select(timestep, self.null_label) if drops else None
            return self.apply_modulations(latent, select(timestep, label), pag_scale, perturbed)

        return denoise

    def apply_modulations(
        self,
        latent: Float[Tensor, "batch c_in h w"],
        modulations: Sequence[Tensor],
        pag_scale: float = 0.0,
        perturbed: Sequence[Tensor] | None = None,
    ) -> Float[Tensor, "batch c h w"]:
        """Predict the noise in latents with precomputed modulations.

        Perturbed-attention guidance (PAG; Ahn et al., ECCV 2024) extrapolates from the prediction of a perturbed
        network to that of the network. In the perturbed network, each token of the block depth // 2 (counted from 0)
        attends only to itself. Both networks share the blocks before, so the guidance costs half an evaluation. From
        this block on, the perturbed network can have other modulations. With those of the null label, the guidance also
        leads towards the label, like classifier-free guidance, at the same cost.

        Args:
            latent: Noisy latents, with or without a known part (see `forward`).
            modulations: Output of the method `modulations`.
            pag_scale: Scale of perturbed-attention guidance; 0 switches it off.
            perturbed: Modulations of the perturbed network; None: the same modulations.

        Returns:
            Predicted noise.

        Raises:
            ValueError: The latents have a known part, but the network was built without `inpainting`.
        """
        patch, tokens = self.config.patch, self.config.size // self.config.patch
        latent, known = latent.split([self.config.channels, latent.shape[1] - self.config.channels], dim=1)
        x = apply_in_float32(self.patch_in, latent).flatten(2).transpose(1, 2) + self.positions  # (b, n, d)
        if known.shape[1]:
            if self.known_in is None:
                raise ValueError("this transformer was trained without --inpainting, so it cannot read a known part")
            x = x + apply_in_float32(self.known_in, known).flatten(2).transpose(1, 2)
        *of_blocks, of_output, shares = modulations
        *of_perturbed, perturbed_output, _ = modulations if perturbed is None else perturbed
        for number, (block, own, other) in enumerate(zip(self.blocks, of_blocks, of_perturbed, strict=True)):
            if pag_scale and number == len(self.blocks) // 2:
                x = torch.cat([block(x, own), block(x, other, perturb=True)])
            else:
                x = block(x, own if len(own) == len(x) else torch.cat([own, other]))
        if pag_scale:
            of_output = torch.cat([of_output, perturbed_output])
        shift, scale = of_output.chunk(2, dim=1)
        x = modulate(F.layer_norm(x, x.shape[-1:], eps=1e-6), shift, scale)
        x = apply_in_float32(self.patch_out, x)  # (b, n, p p c).
        if pag_scale:
            x, without = x.chunk(2)
            x = x + pag_scale * (x - without)
        x = x.unflatten(1, (tokens, tokens)).unflatten(3, (patch, patch, -1))  # (b, i, j, p, q, c).
        x = x.permute(0, 5, 1, 3, 2, 4).flatten(4, 5).flatten(2, 3)
        if self.config.prediction == "epsilon":
            return x
        of_latent, of_velocity = shares[:, :, None, None, None].unbind(1)
        return of_latent * latent + of_velocity * x
