"""Select the scenes that a job reads, without the models' modules, whose import takes seconds."""

from __future__ import annotations

from jobs.support.cli import resolve_path
from jobs.support.options import SceneOptions
from pipelines.schema.scene_subset import SceneSubset


def select_scenes(options: SceneOptions) -> SceneSubset:
    """Return the subset of scenes that the options select."""
    directory = resolve_path(options.input, "generated")
    limit = None if options.scene_ids else options.max_scenes
    return SceneSubset(directory, options.source or None, options.split or None, limit, "first", ids=options.scene_ids)
