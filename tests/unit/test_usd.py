"""Tests of Universal Scene Description files, which usd-core opens and validates."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models.scene import CATEGORIES, ELLIPSOID, Scene
from pipelines.io.usd import export_usd

usd: Any = pytest.importorskip("pxr.Usd", reason="no usd-core")
geometry: Any = pytest.importorskip("pxr.UsdGeom")
validation: Any = pytest.importorskip("pxr.UsdValidation")


def open_stage(scene: Scene, folder: Path) -> Any:
    path = folder / "scene.usd"
    path.write_bytes(export_usd(scene))
    return usd.Stage.Open(str(path))


def test_stage_is_valid_and_has_a_prim_per_primitive(tmp_path, town_drive_3):
    scene = replace(town_drive_3.scene(20), attribution="someone")
    stage = open_stage(scene, tmp_path)
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    errors = validation.ValidationContext(validators).Validate(stage)
    assert len(validators) > 10 and [error.GetMessage() for error in errors] == []
    assert geometry.GetStageUpAxis(stage) == "Z" and geometry.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetCustomData()["pritti"]["attribution"] == "someone"
    shapes = [prim for prim in stage.Traverse() if prim.GetTypeName() in ("Cube", "Sphere")]
    assert len(shapes) == len(scene)
    for prim in shapes:
        index = int(prim.GetName().rpartition("_")[2])
        name = CATEGORIES[scene.category[index]]
        assert prim.GetParent().GetName() == name and (prim.GetTypeName() == "Sphere") == (
            name == CATEGORIES[ELLIPSOID]
        )
        assert prim.GetAttribute("semantics:labels:category").Get()[0] == name
        assert prim.GetAttribute("pritti:label").Get() == scene.label[index]


def test_prims_have_the_bounds_of_primitives(tmp_path, town_drive_3):
    scene = town_drive_3.scene(20)
    stage = open_stage(scene, tmp_path)
    cache = geometry.BBoxCache(usd.TimeCode.Default(), [geometry.Tokens.default_])
    for index in range(0, len(scene), 7):
        name = CATEGORIES[scene.category[index]]
        box = cache.ComputeWorldBound(stage.GetPrimAtPath(f"/Scene/{name}/{name}_{index:05d}"))
        middle = np.array(box.ComputeCentroid())
        assert np.allclose(middle, scene.center_m[index], atol=1e-4)
        reach = np.abs(scene.rotation[index]) @ scene.size_m[index] / 2
        assert np.allclose(np.array(box.ComputeAlignedRange().GetSize()) / 2, reach, rtol=1e-3, atol=1e-3)


def test_ground_has_a_mesh_per_class(tmp_path, town_drive_3):
    scene = town_drive_3.scene(20)
    stage = open_stage(scene, tmp_path)
    areas = {}
    for name in scene.ground_classes:
        prim = stage.GetPrimAtPath(f"/Scene/ground/{name}")
        if prim:
            mesh = geometry.Mesh(prim)
            corners = np.array(mesh.GetPointsAttr().Get())[np.array(mesh.GetFaceVertexIndicesAttr().Get())].reshape(
                -1, 3, 3
            )
            areas[name] = (
                np.linalg.norm(np.cross(*(corners[:, 1:] - corners[:, :1]).transpose(1, 0, 2)), axis=1).sum() / 2
            )
    surface = scene.surface()[1]
    for k, name in enumerate(scene.ground_classes):
        expected = (surface == k).sum() * scene.grid.resolution_m**2
        assert areas.get(name, 0.0) == pytest.approx(expected, rel=0.1, abs=10.0), name


def test_empty_scene_is_a_stage(tmp_path, town_drive_3):
    scene = town_drive_3.scene(0)
    empty = replace(scene.select(np.zeros(len(scene), bool)), occupied=np.zeros_like(scene.occupied))
    assert open_stage(empty, tmp_path).GetDefaultPrim().GetName() == "Scene"
