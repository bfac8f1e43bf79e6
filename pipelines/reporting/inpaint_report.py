"""Render the page of an inpainting run: scenes before and after inpainting, and decoder errors in the known region."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.composition.inpaint import Contents
from models.scene import Scene
from pipelines.rendering.render import render_outlined_bev
from pipelines.reporting.report import Picture, Pictures, Table, render_report_html

PICTURE_PX = 512
PER_ROW = 4  # Pictures per scene: the input scene and its first variants.
SUBJECTS = {"both": "Ground and objects are", "ground": "The ground is", "objects": "The objects are"}


@dataclass(frozen=True)
class InpaintExample:
    """An input scene, its generated region (rows, cols) and its variants."""

    given: Scene
    region: np.ndarray
    variants: Sequence[Scene]


def render_inpaint_html(
    run: str,
    contents: Contents,
    num_variants: int,
    examples: Iterable[InpaintExample],
    drift: Mapping[str, float | None],
) -> str:
    """Render the page of an inpainting run.

    Args:
        run: Run name, shown as the subtitle.
        contents: Contents that were regenerated.
        num_variants: Number of variants per scene.
        examples: Scenes to show.
        drift: Scores of the decoder output in the known region.

    Returns:
        HTML page.
    """
    shown: list[Picture] = []
    for example in examples:
        region, scenes = example.region, example.variants[: PER_ROW - 1]
        shown.append(Picture(example.given.scene_id, render_outlined_bev(example.given, region, PICTURE_PX), "given"))
        shown += [Picture(s.scene_id, render_outlined_bev(s, region, PICTURE_PX), "regenerated") for s in scenes]
    note = (
        f"{SUBJECTS[contents]} regenerated inside the red line. The rest of the scene is copied from the given scene."
    )
    how = (
        "Outside the generated region, the latent equals the latent of the given scene. The decoders process the whole "
        "latent, so their output may still differ outside the region. The table shows these differences. In the "
        "pictures and the tables of scenes, everything outside the region is copied from the given scene."
    )
    pictures = Pictures("Scenes", shown, min(PER_ROW, 1 + num_variants), note)
    table = Table("Decoder errors outside the region", tuple(drift), [tuple(drift.values())], note=how)
    return render_report_html("Inpainting", [pictures, table], run)
