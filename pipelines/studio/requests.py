"""Types of the requests to the studio, including the allowed range of each value."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from models.composition.extend import Side
from models.composition.inpaint import Contents
from models.sampling.repaint import InpaintingConfig, RePaintConfig, TrainedInpainting


class StudioRequest(BaseModel):
    """Base class of all requests; unknown fields, NaN and infinite numbers raise an error."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class ListRequest(StudioRequest):
    start: int = Field(0, ge=0, le=10**9)
    text: str = Field("", max_length=100)


class OpenRequest(StudioRequest):
    scene_id: str = Field(max_length=1000)


# The defaults of --inpainting guided; only the number of steps is smaller in the studio.
GUIDED = RePaintConfig.guided()


class SamplingRequest(StudioRequest):
    # An empty string selects the label of the scene. If the scene has no label, an empty string selects the model's
    # first label.
    label: str = Field("", max_length=40)
    seed: int = Field(0, ge=0, lt=2**31)
    steps: int = Field(20, ge=1, le=1000)
    constraints: bool | None = None  # None selects the default of the studio.


class GenerateRequest(SamplingRequest):
    sampler: Literal["ddpm", "ddim", "dpm++", "sde-dpm++"] = "sde-dpm++"


class RepaintRequest(SamplingRequest):
    jump_length: int = Field(1, ge=1, le=100)
    resamplings: int = Field(GUIDED.resamplings, ge=1, le=20)
    pseudoinverse_guidance: float = Field(GUIDED.pseudoinverse_guidance, ge=0, le=10)
    eta: float = Field(GUIDED.eta, ge=0, le=1)

    def repaint(self, trained: bool) -> InpaintingConfig:
        """Return how known parts are continued; a request that sets options of RePaint uses RePaint."""
        if trained and not {"jump_length", "resamplings", "pseudoinverse_guidance", "eta"} & self.model_fields_set:
            return TrainedInpainting(self.steps)
        return RePaintConfig(self.steps, self.jump_length, self.resamplings, self.pseudoinverse_guidance, self.eta)


class InpaintRegionRequest(RepaintRequest):
    polygon_m: list[tuple[float, float]] = Field(min_length=3, max_length=500)
    contents: Contents = "both"


class ExtendRequest(RepaintRequest):
    side: Side


class EditsRequest(StudioRequest):
    edits: list[dict] = Field(min_length=1, max_length=100)
