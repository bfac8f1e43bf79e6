"""Map option values to the values that pipelines/ and the records of runs use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from pipelines.schema.scene_subset import Pick

# Records of training runs use the names of version 0.1, so runs of version 0.1 can be resumed.
RECORDED_PREDICTIONS = {"epsilon": "noise", "v_prediction": "velocity"}
RECORDED_TIMESTEPS = {"uniform": "even", "logit_normal": "middle"}
REFERENCES: dict[str, Pick] = {"farthest-point": "farthest", "min-distance": "apart", "uniform": "spread"}
EDIT_FRAMES: dict[str, Literal["scene", "own"]] = {"scene": "scene", "object": "own"}
