"""Tests of the sampler without Ray."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.schema.tables import read_scenes


@pytest.mark.slow  # test_constraints.py samples scenes with constraints.
def test_sampler_guides_scenes_by_constraints(tmp_path):
    from jobs.support.model_directories import find_pipeline_directory
    from models.layout import SLAB_OFFSET_M
    from pipelines.generation.sample import Sampler, SampleRequest
    from pipelines.metrics.validity import find_faults

    request = SampleRequest(
        find_pipeline_directory("town"), str(tmp_path), "plain", 4, ("low-medium", "high-low"), 0, 10, 1.0, "dpm++"
    )
    faults = []
    for one in (replace(request, constraints=False), replace(request, run="guided", constraints=True)):
        sampler = Sampler(one, batch_size=4)
        rows = [sampler({"id": 0}) for _ in range(2)]
        steps = {row["guided"] for row in rows}  # Each shard has its own count.
        assert steps == ({12} if one.constraints else {0}) and not rows[0]["fallbacks"]
        made = read_scenes(str(tmp_path), source=one.source)
        found = [find_faults(scene, SLAB_OFFSET_M) for scene in made]
        faults.append(sum(f[name][0].sum() for f in found for name in ("overlapping", "floating", "sunken")))
    assert faults[1] < 0.9 * faults[0]


def test_sampler_repairs_sampled_scenes(tmp_path):
    from jobs.support.model_directories import find_pipeline_directory
    from models.layout import SLAB_OFFSET_M
    from pipelines.generation.sample import Sampler, SampleRequest
    from pipelines.metrics.validity import find_faults

    request = SampleRequest(
        find_pipeline_directory("town"), str(tmp_path), "plain", 6, ("low-medium", "high-low"), 0, 10, 1.0, "dpm++"
    )
    request = replace(request, constraints=False)
    scenes, number = [], []
    for one in (request, replace(request, run="repaired", repair=True)):
        Sampler(one, batch_size=4)({"id": 0})
        made = list(read_scenes(str(tmp_path), source=one.source))
        found = [find_faults(scene, SLAB_OFFSET_M) for scene in made]
        scenes.append(made)
        number.append([sum(f[name][0].sum() for f in found) for name in ("overlapping_iou3d", "floating", "sunken")])
    for before, after in zip(*scenes, strict=True):
        assert np.array_equal(before.category, after.category)
    (overlapping, floating, sunken), after = number
    assert overlapping > 0 and floating + sunken > 0 and after[0] < 0.7 * overlapping and after[1:] == [0, 0]
