"""Export a Scene as Universal Scene Description: one prim per primitive and one mesh for each ground class.

The stage has metres as its unit and z as its up axis, as the scene frame. The package usd-core (extra `usd`) writes and
reads the files.
"""

from __future__ import annotations

import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from models.scene import CATEGORIES, ELLIPSOID, Scene
from pipelines.io.mesh_export import build_painted_ground, compute_placements
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS, CLASS_ID

ROOT = "/Scene"
MODULES = ("Gf", "Sdf", "Usd", "UsdGeom", "UsdSemantics", "Vt")


def export_usd(scene: Scene) -> bytes:
    """Export a scene as a binary USD file.

    Boxes are cubes and ellipsoids are spheres of size 1 with a transformation. Each has its category as a semantic
    label (UsdSemantics), and its category, label, number, size, yaw and existence probability as attributes in the
    namespace `pritti`.

    Args:
        scene: Scene.

    Returns:
        Content of the .usd file.

    Raises:
        ValueError: The package usd-core is missing.
    """
    try:
        modules: list[Any] = [import_module(f"pxr.{name}") for name in MODULES]
    except ImportError as error:
        raise ValueError("USD needs the extra usd: pip install 'pritti-on-ray[usd]'") from error
    Gf, Sdf, Usd, UsdGeom, UsdSemantics, Vt = modules
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, ROOT)
    stage.SetDefaultPrim(root.GetPrim())
    about = {"scene_id": scene.scene_id, "source": scene.source, "sequence": scene.sequence}
    about |= {"world_xyz_m": [float(v) for v in scene.world_xyz_m], "world_yaw_rad": float(scene.world_yaw_rad)}
    root.GetPrim().SetCustomData({"pritti": about | ({"attribution": scene.attribution} if scene.attribution else {})})
    if scene.attribution:
        stage.GetRootLayer().comment = scene.attribution

    def label(prim: Any, name: str) -> None:
        semantics = UsdSemantics.LabelsAPI.Apply(prim, "category")
        semantics.CreateLabelsAttr([name])

    def color(shape: Any, class_id: int) -> None:
        linear = (CLASS_COLORS[class_id] / 255.0) ** 2.2
        shape.CreateDisplayColorAttr([tuple(float(v) for v in linear)])

    vertices_m, triangles, class_id = build_painted_ground(scene)
    UsdGeom.Scope.Define(stage, f"{ROOT}/ground")
    for name in scene.ground_classes:
        chosen = triangles[class_id[triangles[:, 0]] == CLASS_ID[name]]
        if not len(chosen):
            continue
        used, corner = np.unique(chosen, return_inverse=True)
        mesh = UsdGeom.Mesh.Define(stage, f"{ROOT}/ground/{name}")
        points = np.ascontiguousarray(vertices_m[used], np.float32)
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        mesh.CreateFaceVertexCountsAttr([3] * len(chosen))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corner.ravel().astype(np.int32)))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateExtentAttr([tuple(map(float, points.min(axis=0))), tuple(map(float, points.max(axis=0)))])
        color(mesh, CLASS_ID[name])
        label(mesh.GetPrim(), name)
    placements = compute_placements(scene)
    for index, category in enumerate(scene.category):
        name = CATEGORIES[category]
        path = f"{ROOT}/{name}/{name}_{index:05d}"
        if not stage.GetPrimAtPath(f"{ROOT}/{name}"):
            UsdGeom.Scope.Define(stage, f"{ROOT}/{name}")
        if category == ELLIPSOID:
            shape = UsdGeom.Sphere.Define(stage, path)
            shape.CreateRadiusAttr(0.5)
        else:
            shape = UsdGeom.Cube.Define(stage, path)
            shape.CreateSizeAttr(1.0)
        shape.CreateExtentAttr([(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)])
        # USD multiplies row vectors from the left.
        shape.AddTransformOp().Set(Gf.Matrix4d(placements[index].astype(float).T.tolist()))
        color(shape, int(CATEGORY_IDS[category]))
        prim = shape.GetPrim()
        label(prim, name)
        kinds = Sdf.ValueTypeNames
        values = {
            "label": (kinds.String, str(scene.label[index])),
            "instance_id": (kinds.Int64, int(scene.instance_id[index])),
            "size_m": (kinds.Double3, tuple(float(v) for v in scene.size_m[index])),
            "yaw_rad": (kinds.Double, float(scene.yaw_rad[index])),
            "existence": (kinds.Double, float(scene.existence[index])),
        }
        for key, (kind, value) in values.items():
            prim.CreateAttribute(f"pritti:{key}", kind, custom=True).Set(value)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.usd"
        stage.GetRootLayer().Export(str(path))
        return path.read_bytes()
