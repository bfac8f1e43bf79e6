"""The layout VAE (paper, Sec. 3.2 and supplement B.2).

The layout VAE has a ground branch and an object branch. The latents of both branches are concatenated along the channel
axis to one joint latent.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from models.base import ConfiguredModel, register_to_config
from models.batch import LayoutBatch
from models.layout import FEATURES, LayoutSpec
from models.vae.cell_decoder import CellDecoder
from models.vae.config import Branches, GroundConfig, LayoutVAEConfig, ObjectConfig, nest_flat_options, parse_options
from models.vae.detr_decoder import DETRDecoder
from models.vae.ground import GroundDecoder, GroundEncoder, compute_edge_reach_px, init_from_data
from models.vae.level_sets import LevelSetDecoder, init_level_sets
from models.vae.local_frame import LocalFrame
from models.vae.matching import MatchWeights
from models.vae.objects import ObjectEncoder
from models.vae.outputs import LayoutOutput, Posterior, Proposals

# Initial log-variance of the posterior (sigma 0.14). With this small sigma, the latent mean is larger than the noise
# from the first step. With sigma 1, the loss after 300 steps on one batch is 1.5 times as high
# (tests/unit/test_models.py).
INITIAL_LOGVAR = -4.0
SOLVED_LOGVAR = -8.0  # Sigma 0.018, for a ground branch with a shortcut (models/vae/ground.py).

BRANCHES = ("both", "ground", "objects")
OBJECT_DECODER = "object_decoder."  # Prefix of the object decoder's parameter names.
EMPTY_LOGIT = -6.0  # Occupancy logit of a model without a ground branch.
# Standard deviation of the noise on true primitives of denoising queries: centre (m) and Cholesky parameters (sqrt(m)).
DENOISING_NOISE = (1.0, 0.2)


def compute_clamped_logit(probability: Tensor) -> Tensor:
    """Clamp probabilities to [0.01, 0.99] and compute their logits.

    Args:
        probability: Probabilities, any shape.

    Returns:
        Logits of the same shape.
    """
    return probability.clamp(0.01, 0.99).logit()


class LayoutVAE(ConfiguredModel):
    """Encode layouts to latents (2 c, h, w) and decode latents to layouts; h = w = pixels / `ground.cell_px`.

    Args:
        layout: LayoutSpec as a dictionary. The dictionary is saved with the model, because decoding outputs needs it.
        latent_channels: Number c of latent channels per branch.
        ground: Options of the ground branch.
        objects: Options of the object branch.
        shortcut: See `LayoutVAEConfig`.
        split_latent: See `LayoutVAEConfig`.
        branches: "both", "ground" or "objects". If a model has only one branch, its latent has c channels. In its
            decoded layouts, the part of the other branch is empty.
        local_frame: See `LayoutVAEConfig`. It needs both branches, the cell decoder and a ground class "road".

    Raises:
        ValueError: An option is unknown, the grid does not divide into latent cells, or the model cannot have a local
            frame.
    """

    @register_to_config
    def __init__(
        self,
        layout: dict[str, Any],
        latent_channels: int = 32,
        ground: GroundConfig = LayoutVAEConfig.ground,
        objects: ObjectConfig = LayoutVAEConfig.objects,
        shortcut: bool = False,
        split_latent: bool = True,
        branches: Branches | str = "both",
        local_frame: bool = False,
    ) -> None:
        super().__init__()
        if branches not in BRANCHES:
            raise ValueError(f"LayoutVAE: branches is {branches!r}, expected one of {BRANCHES}")
        if objects.decoder not in ("detr", "cells"):
            raise ValueError(f"LayoutVAE: decoder is {objects.decoder!r}, expected 'detr' (as in the paper) or 'cells'")
        spec = LayoutSpec.from_dict(layout)
        if spec.grid.rows != spec.grid.cols or spec.grid.rows % ground.cell_px:
            raise ValueError(
                f"LayoutVAE: the side of the square grid must be a multiple of {ground.cell_px} px, got {spec.grid}"
            )
        size, num_classes = spec.grid.rows // ground.cell_px, len(spec.ground_classes)
        cell_m = spec.grid.rows * spec.grid.resolution_m / size
        if local_frame and (branches != "both" or objects.decoder != "cells"):
            raise ValueError("LayoutVAE: local_frame needs both branches and the decoder 'cells'")
        self.local_frame = LocalFrame(spec) if local_frame else None
        self.feature_unit = {  # Unit of distances in losses.
            "normalised": (1.0,) * FEATURES,
            "metres": spec.feature_unit(1.0),
            "cells": spec.feature_unit(cell_m),
        }[objects.loss_unit]
        self.latent_shape = (
            latent_channels * (2 if branches == "both" else 1),
            size,
            size,
        )
        seen = latent_channels if split_latent else self.latent_shape[0]  # Number of channels that each decoder reads.
        self.ground_encoder = self.ground_decoder = self.object_encoder = self.object_decoder = None
        if branches != "objects":
            self.ground_encoder = GroundEncoder(num_classes, latent_channels, ground, shortcut)
            kind = LevelSetDecoder if ground.level_sets else GroundDecoder
            self.ground_decoder = kind(num_classes, seen, ground, shortcut)
        if branches != "ground":
            self.object_encoder = ObjectEncoder(spec.slots, latent_channels, size, objects, shortcut)
            if objects.decoder == "detr":
                self.object_decoder = DETRDecoder(spec.slots, seen, size, objects)
            else:
                self.object_decoder = CellDecoder(spec.slots, seen, size, objects)

    @classmethod
    def upgrade_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Nest the options of a flat config, which versions before 0.2 wrote.

        Args:
            config: Current or flat config.

        Returns:
            Entries with the names of this version.
        """
        return nest_flat_options(config)

    @classmethod
    def parse_config(cls, config: dict[str, Any]) -> dict[str, Any]:
        """Check all entries, and convert the options of the branches to dataclasses.

        Args:
            config: Value of every constructor argument.

        Returns:
            Keyword arguments of the constructor.

        Raises:
            ValueError: An entry has an invalid value.
        """
        LayoutSpec.from_dict(config["layout"])
        return parse_options(config)

    @torch.no_grad()
    def init_from_data(self, batch: LayoutBatch) -> None:
        """Initialise outputs to their means over a sample of training layouts, and the posterior to a small variance.

        Adam moves a bias by about the learning rate per step. With initial biases of zero, training would need
        thousands of steps to learn that poles are thin and that most pixels are not road. With a posterior variance of
        1, the noise would hide the latent mean at first. For the initialisation of the shortcuts, see
        models/vae/ground.py.

        Args:
            batch: Training layouts.
        """
        channels = self.config.latent_channels
        if self.ground_encoder and self.ground_decoder:
            if isinstance(self.ground_decoder, LevelSetDecoder):
                init_level_sets(self.ground_encoder, self.ground_decoder, batch.height, batch.occupied)
            else:
                init_from_data(self.ground_encoder, self.ground_decoder, batch.height, batch.occupied)
            bias = cast(Tensor, self.ground_encoder.net.conv_out.bias)
            bias[channels:] = SOLVED_LOGVAR if self.config.shortcut else INITIAL_LOGVAR
        if not (self.object_encoder and self.object_decoder):
            return
        self.object_encoder.grid[channels:] = INITIAL_LOGVAR
        local = self.convert_to_local(batch.features, batch.real, self.measure_local_field(batch))
        groups = list(zip(local.split(self.spec.slots, 1), batch.real.split(self.spec.slots, 1), strict=True))
        features = torch.stack([f[r].mean(dim=0) if r.any() else f.new_full((FEATURES,), 0.5) for f, r in groups])
        count = torch.stack([r.sum() / len(r) for _, r in groups])
        self.object_decoder.init_from_data(compute_clamped_logit(features), count)

    def freeze_all_but_object_decoder(self, state: dict[str, Tensor]) -> None:
        """Load the weights of another model, and freeze all parameters except those of the object decoder.

        The other model must have the same encoders. Both models then encode a scene to the same latent. A diffusion
        transformer that was trained on the latents of the other model can therefore be used with this model.

        Args:
            state: State dict of the other model; its object decoder is ignored.
        """
        mine = {name: value for name, value in self.state_dict().items() if name.startswith(OBJECT_DECODER)}
        theirs = {name: value for name, value in state.items() if not name.startswith(OBJECT_DECODER)}
        self.load_state_dict(theirs | mine)
        for name, parameter in self.named_parameters():
            parameter.requires_grad_(name.startswith(OBJECT_DECODER))

    def learning_rate_factors(self) -> dict[str, float]:
        """Return a mapping from prefixes of parameter names to factors of the learning rate.

        Parameters that are initialised in closed form have factors below 1.
        """
        if not self.config.shortcut:
            return {}
        return {"ground_encoder.shortcut": 0.05, "ground_decoder.shortcut": 0.05, "ground_": 0.25}

    def list_parts_to_compile(self) -> list[nn.Module]:
        """Return the modules that take most of the time: the convolutional networks and the transformer layers."""
        parts: list[nn.Module] = [part.net for part in (self.ground_encoder, self.ground_decoder) if part]
        for branch in (self.object_encoder, self.object_decoder):
            parts += getattr(branch, "layers", [])  # The cell decoder has none.
        return parts

    @property
    def reach_px(self) -> int:
        """Largest distance from an edge that the smooth maps of the ground branch represent, in pixels."""
        return compute_edge_reach_px(self.spec.grid.rows // self.latent_shape[-1])

    @property
    def proposes_duplicates(self) -> bool:
        """True if two proposals may decode the same object: two cells of the cell decoder."""
        return self.config.objects["decoder"] == "cells"

    @property
    def spec(self) -> LayoutSpec:
        """Layout of the scenes."""
        return LayoutSpec.from_dict(self.config.layout)

    def convert_to_local(
        self, features: Float[Tensor, "batch n 9"], real: Bool[Tensor, "batch n"], local_field: Tensor | None
    ) -> Float[Tensor, "batch n 9"]:
        """Convert the features of primitives from the scene frame to the local frame, if the model has one.

        Args:
            features: Normalised features.
            real: True for each slot that holds a primitive; the features of other slots do not change.
            local_field: Output of `measure_local_field`.

        Returns:
            Features that the object encoder reads.
        """
        if self.local_frame is None or local_field is None:
            return features
        return torch.where(real[..., None], self.local_frame.to_local(features, local_field), features)

    def encode(self, batch: LayoutBatch, local_field: Tensor | None = None) -> Posterior:
        """Encode layouts to the joint posterior.

        Args:
            batch: Layouts.
            local_field: Output of `measure_local_field` for this batch; None: it is computed.

        Returns:
            Posterior; its channels are the ground channels, then the object channels.
        """
        moments = []
        if self.ground_encoder:
            distance = batch.measure_distances_px(self.reach_px) if self.config.shortcut else None
            maps = torch.cat([batch.height, batch.occupied], dim=1)
            moments.append(self.ground_encoder(maps, distance).chunk(2, 1))
        if self.object_encoder:
            field = self.measure_local_field(batch) if local_field is None else local_field
            features = self.convert_to_local(batch.features, batch.real, field)
            moments.append(self.object_encoder(features, batch.real).chunk(2, 1))
        mean, logvar = (torch.cat(part, dim=1) for part in zip(*moments, strict=True))
        return Posterior(mean, logvar.clamp(-30, 20))

    def decode(
        self,
        latent: Float[Tensor, "batch c2 h w"],
        noised: Tensor | None = None,
        real: Tensor | None = None,
        raster_px: int | None = None,
        local_field: Tensor | None = None,
    ) -> LayoutOutput:
        """Decode latents to layouts.

        With `split_latent`, each decoder reads only its half of the channels. Otherwise, both decoders read all
        channels.

        Args:
            latent: Joint latents.
            noised: (batch, groups, N, 9) features of true primitives with noise, for denoising queries in training.
            real: (batch, N); True for each slot that holds a primitive.
            raster_px: Number of rows and of columns of the rasters; None: that of the LayoutSpec. Only level sets have
                another resolution.
            local_field: Field of the local frame (`measure_local_field`); None: the field of the decoded ground.
                Training uses the field of the true ground, so errors of the ground do not become errors of objects.

        Returns:
            Output of both decoders.

        Raises:
            ValueError: The model has no level sets, and `raster_px` differs from the rows of the LayoutSpec.
        """
        ground, objects = self.split(latent)
        height, occupancy_logit, distance = self.decode_ground(ground, raster_px)
        if local_field is None:
            local_field = self.compute_local_field(ground, height, occupancy_logit)
        found, decoder = self.decode_objects(objects, local_field, noised, real), self.object_decoder
        return LayoutOutput(
            height,
            occupancy_logit,
            found.features,
            found.existence_logit,
            decoder.proposals if decoder else (0,) * len(self.spec.slots),
            decoder.match_weights if decoder else MatchWeights(),
            self.feature_unit,
            self.config.branches,
            found.auxiliary,
            found.denoised,
            distance,
            self.reach_px,
            local_field,
        )

    def split(self, latent: Float[Tensor, "batch c2 h w"]) -> tuple[Tensor, Tensor]:
        """Return the channels that the ground decoder reads, and those that the object decoder reads.

        Args:
            latent: Joint latents.

        Returns:
            Ground latent and object latent; both are the joint latent without `split_latent` or with one branch.
        """
        is_split = self.config.split_latent and self.config.branches == "both"
        ground, objects = latent.chunk(2, dim=1) if is_split else (latent, latent)
        return ground, objects

    def decode_ground(
        self, latent: Float[Tensor, "batch c h w"], raster_px: int | None = None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Decode the ground.

        Args:
            latent: Channels that the ground decoder reads.
            raster_px: See `decode`.

        Returns:
            Normalised heights, occupancy logits, and signed distances in units of `reach_px` pixels (None without level
            sets). If the model has no ground branch, all pixels are unoccupied.

        Raises:
            ValueError: The model has no level sets, and `raster_px` differs from the rows of the LayoutSpec.
        """
        if isinstance(self.ground_decoder, LevelSetDecoder):
            return self.ground_decoder(latent, raster_px)
        grid = self.spec.grid
        if raster_px not in (None, grid.rows):
            raise ValueError(
                f"raster_px is {raster_px}, but this model decodes rasters of {grid.rows} pixels; "
                "only models with level sets (preset town) decode other resolutions"
            )
        if self.ground_decoder:
            height, logit = self.ground_decoder(latent).chunk(2, dim=1)
            return height, logit, None
        height = latent.new_zeros(len(latent), len(self.spec.ground_classes), grid.rows, grid.cols)
        return height, torch.full_like(height, EMPTY_LOGIT), None

    def measure_local_field(self, batch: LayoutBatch) -> Tensor | None:
        """Compute the direction of the streets and the height of the ground of layouts.

        Args:
            batch: Layouts.

        Returns:
            Field for `decode_objects`; None without a local frame.
        """
        if self.local_frame is None:
            return None
        return self.local_frame.compute_field(batch.height, batch.occupied > 0.5)

    @torch.no_grad()
    def compute_local_field(
        self,
        latent: Float[Tensor, "batch c h w"],
        height: Float[Tensor, "batch ground rows cols"],
        occupancy_logit: Float[Tensor, "batch ground rows cols"],
    ) -> Tensor | None:
        """Compute the direction of the streets and the height of the ground of decoded grounds.

        Args:
            latent: Channels that the ground decoder reads.
            height: Decoded heights.
            occupancy_logit: Decoded occupancy. If its resolution differs from that of the LayoutSpec, the ground is
                decoded again, so objects do not depend on the resolution of the rasters.

        Returns:
            Field for `decode_objects`; None without a local frame.
        """
        if self.local_frame is None:
            return None
        if occupancy_logit.shape[2] != self.spec.grid.rows:
            height, occupancy_logit, _ = self.decode_ground(latent)
        return self.local_frame.compute_field(height, occupancy_logit > 0)

    def decode_objects(
        self,
        latent: Float[Tensor, "batch c h w"],
        local_field: Tensor | None = None,
        noised: Tensor | None = None,
        real: Tensor | None = None,
    ) -> Proposals:
        """Decode the objects.

        Args:
            latent: Channels that the object decoder reads.
            local_field: Output of `compute_local_field`.
            noised: (batch, groups, N, 9) features of true primitives with noise, for denoising queries.
            real: (batch, N); True for each slot that holds a primitive.

        Returns:
            Predicted primitives. If the model has no object branch, there are none.

        Raises:
            ValueError: The model has a local frame, and `local_field` is None.
        """
        if isinstance(self.object_decoder, DETRDecoder):
            return self.object_decoder(latent, noised, real)
        if self.object_decoder:
            found = self.object_decoder(latent)
            if self.local_frame is None:
                return found
            if local_field is None:
                raise ValueError("decode_objects: a model with a local frame needs local_field (compute_local_field)")
            return found._replace(features=self.local_frame.to_scene(found.features, local_field))
        features = latent.new_zeros(len(latent), 0, FEATURES)
        return Proposals(features, features[..., 0])

    def forward(
        self,
        batch: LayoutBatch,
        noise: Float[Tensor, "batch c2 h w"],
        corruption: Float[Tensor, "batch c2 h w"] | None = None,
        query_noise: Float[Tensor, "batch groups n 9"] | None = None,
    ) -> tuple[LayoutOutput, Posterior]:
        """Sample latents from the posterior and decode them.

        The paper adds no corruption to the latent. Zheng et al. (RAE, 2025) also train decoders with noisy latents. In
        this project, encoders and decoders are trained together, and each scene has its own noise level
        (`models.training.sample_corruption`).

        Args:
            batch: Layouts.
            noise: Standard normal noise of the reparameterisation.
            corruption: Noise that is added to the latent; None: no noise. The unit of this noise is the standard
                deviation of each channel over the cells of a scene. This noise makes decoders tolerate errors in
                sampled latents.
            query_noise: Standard normal noise of the denoising queries; None: no denoising queries.

        Returns:
            Output of the decoders, and the posterior.
        """
        field = self.measure_local_field(batch)
        posterior = self.encode(batch, field)
        latent = posterior.sample(noise)
        if corruption is not None:
            latent = latent + corruption * posterior.mean.std(dim=(2, 3), keepdim=True)
        noised = None
        if query_noise is not None:
            center, cholesky = DENOISING_NOISE
            scale = self.spec.feature_unit(center)[:3] + self.spec.feature_unit(cholesky**2)[3:]
            noised = (batch.features[:, None] + query_noise * query_noise.new_tensor(scale)).clamp(0, 1)
        return self.decode(latent, noised, batch.real, local_field=field), posterior
