"""Tests of the GLB export: trimesh reads nodes, corners, volumes and colours."""

import io
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers import empty_scene, example_scene

from models.scene import (
    CATEGORIES,
    ELLIPSOID,
    KITTI_GROUND_CLASSES,
    Grid,
    Scene,
)
from pipelines.io.mesh_export import (
    GLTF_FROM_SCENE,
    GROUND,
    build_ground_mesh,
    build_painted_ground,
    compute_placements,
    export_glb,
    triangulate_scene,
    write_glb,
)
from pipelines.schema.palette import CATEGORY_IDS, CLASS_COLORS, COLOR_HEX, GROUND_CLASS_ID, parse_rgb


def load_glb(glb: bytes) -> trimesh.Scene:
    return trimesh.load_scene(io.BytesIO(glb), file_type="glb")


def place_mesh(loaded: trimesh.Scene, node: str) -> trimesh.Trimesh:
    """Return the mesh of a node in the scene frame (z up)."""
    gltf_from_mesh, geometry = loaded.graph[node]
    mesh = loaded.geometry[geometry].copy()
    mesh.apply_transform(np.linalg.inv(GLTF_FROM_SCENE) @ gltf_from_mesh)
    return mesh


def test_scene_glb_has_named_node_per_primitive_and_ground():
    scene = example_scene()
    loaded = load_glb(export_glb(scene))
    expected = {f"{CATEGORIES[c]}_{i:04d}" for i, c in enumerate(scene.category)} | {"ground"}
    assert set(loaded.graph.nodes_geometry) == expected
    assert len(loaded.geometry) == len(CATEGORIES) + 1  # all nodes of a category use the same mesh
    extras = loaded.graph.transforms.edge_data[("scene", "human_0005")]["metadata"]
    assert extras["category"] == "human" and extras["class_id"] == 11 and extras["instance_id"] == 1005
    assert extras["kind"] == "cuboid" and extras["heading_rad"] is None and extras["existence"] == 1.0
    assert np.array_equal(np.float32(extras["size_m"]), scene.size_m[5])


def test_scene_glb_is_y_up_with_forward_z_and_left_x():
    assert np.isclose(np.linalg.det(GLTF_FROM_SCENE), 1)
    forward, left, up = np.eye(3)
    assert np.array_equal(GLTF_FROM_SCENE[:3, :3] @ forward, [0, 0, 1])
    assert np.array_equal(GLTF_FROM_SCENE[:3, :3] @ left, [1, 0, 0])
    assert np.array_equal(GLTF_FROM_SCENE[:3, :3] @ up, [0, 1, 0])


def test_scene_glb_keeps_corners_and_volumes():
    scene = example_scene()
    loaded = load_glb(export_glb(scene))
    signs = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    for i, category in enumerate(scene.category):
        mesh = place_mesh(loaded, f"{CATEGORIES[category]}_{i:04d}")
        assert mesh.is_watertight and mesh.is_winding_consistent
        if category == ELLIPSOID:
            assert 0.985 < mesh.volume / scene.volume_m3[i] < 1
            continue
        assert np.isclose(mesh.volume, scene.volume_m3[i], rtol=1e-5)
        corners = (signs * scene.size_m[i]) @ scene.rotation[i].T + scene.center_m[i]
        distance = np.linalg.norm(corners[:, None] - mesh.vertices[None], axis=-1)
        assert distance.min(axis=1).max() < 1e-3


def test_ground_mesh_is_fused_surface_at_pixel_centers():
    scene = example_scene()
    vertices, triangles, class_id = build_ground_mesh(scene)
    height, winner = scene.surface()
    row, col = scene.grid.pixel(vertices[:, 0], vertices[:, 1])
    assert len(vertices) == (winner >= 0).sum()
    assert np.allclose(scene.grid.x_m()[row], vertices[:, 0]) and np.allclose(scene.grid.y_m()[col], vertices[:, 1])
    assert np.array_equal(vertices[:, 2].astype(np.float32), height[row, col])
    names = np.array(scene.ground_classes)[winner[row, col]]
    assert np.array_equal(class_id, [GROUND_CLASS_ID[name] for name in names])
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    assert (mesh.face_normals[:, 2] > 0.5).all()
    quads = sum(
        (winner[i : i + 2, j : j + 2] >= 0).all() for i in range(0, 255, 5) for j in range(0, 255, 5)
    )  # compare every 25th block with brute force
    first = vertices[triangles[::2, 0]]
    at_row, at_col = scene.grid.pixel(first[:, 0], first[:, 1])
    assert ((at_row % 5 == 0) & (at_col % 5 == 0)).sum() == quads

    loaded = place_mesh(load_glb(export_glb(scene)), "ground")
    vertices, triangles, _ = build_painted_ground(scene)
    assert np.allclose(loaded.vertices, vertices, atol=1e-4) and np.array_equal(loaded.faces, triangles)


def test_ground_mesh_diagonal_and_winding_of_one_block():
    grid = Grid(front_m=2, left_m=1, resolution_m=1, rows=2, cols=2)
    scene = example_scene(0, grid)
    height, occupied = np.zeros((5, 2, 2), np.float32), np.zeros((5, 2, 2), bool)
    occupied[0] = True
    one = Scene(
        **{name: getattr(scene, name) for name in ("scene_id", "source", "sequence", "frame", "split", "category")},
        **{name: getattr(scene, name) for name in ("center_m", "rotation", "size_m", "ground_classes")},
        height_m=height,
        occupied=occupied,
        grid=grid,
    )
    _, triangles, _ = build_ground_mesh(one)
    assert {frozenset(t) for t in triangles.tolist()} == {frozenset({0, 1, 2}), frozenset({1, 2, 3})}


def convert_to_linear_light(color_hex: str) -> np.ndarray:
    srgb = np.array(parse_rgb(color_hex)) / 255
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def test_scene_glb_colors_are_palette_in_linear_light():
    glb = export_glb(example_scene())
    header = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    factors = {m["name"]: m["pbrMetallicRoughness"]["baseColorFactor"][:3] for m in header["materials"]}
    assert np.allclose(factors.pop("ground"), 1)
    assert set(factors) == set(CATEGORIES)
    for name, factor in factors.items():
        assert np.allclose(factor, convert_to_linear_light(COLOR_HEX[name]), atol=0.5 / 255 + 1e-6)
    painted = load_glb(glb).geometry["ground"].visual.vertex_attributes["color"][:, :3] / 255
    expected = np.array([convert_to_linear_light(COLOR_HEX[name]) for name in KITTI_GROUND_CLASSES])
    distance = np.abs(painted[::97, None] - expected[None]).max(axis=-1)
    assert distance.min(axis=1).max() <= 0.5 / 255 + 1e-6
    assert (distance.min(axis=0) < 0.01).all()  # the scene contains each class


def test_scene_triangles_are_closed_per_primitive():
    scene = example_scene()
    corners, class_id, primitive = triangulate_scene(scene)
    assert len(corners) == len(class_id) == len(primitive)
    signed = (corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum(axis=1) / 6
    volume = np.bincount(primitive[primitive != GROUND], signed[primitive != GROUND])
    assert np.allclose(volume, scene.volume_m3, rtol=0.015)
    objects = primitive != GROUND
    assert np.array_equal(class_id[objects], CATEGORY_IDS[scene.category[primitive[objects]]])
    assert set(class_id[~objects]) <= set(GROUND_CLASS_ID.values())
    assert CLASS_COLORS[class_id].shape == (len(corners), 3)


def test_scene_from_unit_places_unit_box():
    scene = example_scene()
    corner = compute_placements(scene) @ np.array([0.5, 0.5, 0.5, 1])
    expected = scene.center_m + np.einsum("nij,nj->ni", scene.rotation, scene.size_m / 2)
    assert np.allclose(corner[:, :3], expected, atol=1e-4)


def test_scene_glb_accepts_empty_scene():
    scene = empty_scene()
    assert triangulate_scene(scene).corners_m.shape == (0, 3, 3)
    loaded = load_glb(export_glb(scene))
    assert len(loaded.graph.nodes_geometry) == 0 and "scene" in loaded.graph.nodes


def test_scene_glb_passes_khronos_validator(tmp_path):
    """The glTF validator finds every mesh and reports no errors, warnings, infos or hints."""
    modules = Path(sys.prefix) / "npm" / "node_modules"  # the Makefile installs the validator if npm exists
    if not (shutil.which("node") and modules.is_dir()):
        pytest.skip("no node, or no gltf-validator in .venv/npm")
    scenes = [example_scene(), example_scene(3), replace(example_scene(2), occupied=np.zeros((5, 256, 256), bool))]
    paths = [tmp_path / f"{number}.glb" for number in range(len(scenes))]
    for scene, path in zip(scenes, paths, strict=True):
        write_glb(scene, path)
    script = Path(__file__).with_name("validate_glb.js")
    done = subprocess.run(["node", script, modules, *paths], capture_output=True, text=True, check=True)
    for report, scene in zip(json.loads(done.stdout), scenes, strict=True):
        assert report["issues"]["messages"] == []
        assert (
            report["info"]["drawCallCount"] == len(np.unique(scene.category)) + scene.occupied.any()
        )  # number of meshes


def test_write_glb_leaves_only_its_file(tmp_path):
    scene = example_scene(5)
    write_glb(scene, tmp_path / "scene.glb")
    assert [p.name for p in tmp_path.iterdir()] == ["scene.glb"]
    assert (tmp_path / "scene.glb").read_bytes() == export_glb(scene)
    with pytest.raises(FileNotFoundError):
        write_glb(scene, tmp_path / "missing" / "scene.glb")
