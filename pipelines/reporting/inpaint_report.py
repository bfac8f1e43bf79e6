"""The page of an inpainting run: scenes before and after, and how far decoders are off outside the region."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from models.composition.inpaint import Contents
from models.scene import Scene
from pipelines.rendering.render import render_outlined_bev
from pipelines.reporting.report import Picture, Pictures, Table, render_report_html

PICTURE_PX = 512
PER_ROW = 4  # pictures of a scene: as given, and its first variants
SUBJECTS = {"both": "everything is", "ground": "the ground is", "objects": "the objects are"}


@dataclass(frozen=True)
class InpaintExample:
    """A scene as given, its regenerated region (rows, cols) and its variants."""

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
    """Render the page.

    Args:
        run: Name of the run, the subtitle.
        contents: What was regenerated.
        num_variants: Variants per scene.
        examples: Scenes to show.
        drift: Scores of the decoders' output outside the region.
    """
    shown: list[Picture] = []
    for example in examples:
        region, scenes = example.region, example.variants[: PER_ROW - 1]
        shown.append(Picture(example.given.scene_id, render_outlined_bev(example.given, region, PICTURE_PX), "given"))
        shown += [Picture(s.scene_id, render_outlined_bev(s, region, PICTURE_PX), "regenerated") for s in scenes]
    note = f"Inside the red line {SUBJECTS[contents]} regenerated; the rest is the given scene's."
    how = (
        "The latent outside the region is the given scene's, bit for bit, but decoders see the whole latent. The table "
        "shows how far their output is off there. The scenes above and in the tables take that part from the given "
        "scene."
    )
    pictures = Pictures("Scenes", shown, min(PER_ROW, 1 + num_variants), note)
    table = Table("Drift outside the region", tuple(drift), [tuple(drift.values())], note=how)
    return render_report_html("Inpainting", [pictures, table], run)
