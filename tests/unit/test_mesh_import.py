"""Tests of the GLB import for exports of PrITTI on Ray and for files in the format of the paper's authors.

docs/how_to/import_scenes.md describes both formats.
"""

import base64
import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers import random_rotations, random_scene

from models.scene import CATEGORIES, CATEGORY_INDEX, ELLIPSOID, GROUND_CLASSES, Grid, Scene, canonicalize_boxes
from pipelines.io.mesh_export import export_glb
from pipelines.io.mesh_import import import_glb
from pipelines.schema.palette import COLOR_HEX, parse_rgb

SIGNS = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
Z_DOWN = np.diag([1.0, -1.0, -1.0])
CAR = CATEGORY_INDEX["vehicle_small"]


@pytest.fixture(scope="module")
def town_scenes(town_drive_3) -> list[Scene]:
    return [town_drive_3.scene(k, "test") for k in (0, len(town_drive_3) // 2)]


def compute_corners_m(scene: Scene) -> np.ndarray:
    """Return the corners (n, 8, 3) of all primitives in m."""
    return (SIGNS * scene.size_m[:, None]) @ np.swapaxes(scene.rotation, 1, 2) + scene.center_m[:, None]


def compute_scatter_m2(scene: Scene) -> np.ndarray:
    """Return R diag(size)^2 R^T (n, 3, 3), which describes an ellipsoid independently of the order of the axes."""
    axes = scene.rotation.astype(float) * scene.size_m[:, None]
    return axes @ np.swapaxes(axes, 1, 2)


def list_surface_classes(scene: Scene) -> np.ndarray:
    return np.array([*scene.ground_classes, ""])[scene.surface()[1]]


def assert_same_ground(got: Scene, want: Scene) -> None:
    assert np.array_equal(got.surface()[0], want.surface()[0])
    assert np.array_equal(list_surface_classes(got), list_surface_classes(want))
    assert np.array_equal(got.occupied.sum(axis=0), want.occupied.any(axis=0))  # each pixel has one class


def edit_glb(glb: bytes, change) -> bytes:
    """Return the GLB file after the function `change` has edited its JSON."""
    size = int.from_bytes(glb[12:16], "little")
    tree = json.loads(glb[20 : 20 + size])
    change(tree)
    header = json.dumps(tree).encode()
    header += b" " * (-len(header) % 4)
    body = len(header).to_bytes(4, "little") + b"JSON" + header + glb[20 + size :]
    return glb[:8] + (12 + len(body)).to_bytes(4, "little") + body


# ------------------------------------------------------------------------------------------------------ own exports


def assert_same_scene(got: Scene, want: Scene) -> None:
    assert np.abs(compute_corners_m(got) - compute_corners_m(want)).max(initial=0) < 1e-3
    for name in ("category", "center_m", "size_m", "existence", "heading_rad", "instance_id", "label"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), name)
    for name in ("scene_id", "source", "sequence", "frame", "split", "grid", "ground_classes", "world_xyz_m"):
        assert getattr(got, name) == getattr(want, name), name
    for name in ("world_yaw_rad", "vegetation_density", "vehicle_density"):
        assert getattr(got, name) == getattr(want, name), name
    assert_same_ground(got, want)


def test_scene_from_glb_round_trips_own_export(town_scenes):
    labelled = replace(town_scenes[0], vegetation_density="high", vehicle_density="low")
    for scene in (*town_scenes, labelled, random_scene(1, tilt_rad=np.pi)):
        got = import_glb(export_glb(scene))
        assert_same_scene(got, scene)
        assert np.abs(got.rotation - scene.rotation).max() < 1e-6
    assert len(scene) == 40 and sum(len(s) for s in town_scenes) > 100 and labelled.occupied.any()


def test_scene_from_glb_keeps_fused_scene(town_scenes):
    once = import_glb(export_glb(town_scenes[0]))
    twice = import_glb(export_glb(once))
    assert np.array_equal(once.height_m, twice.height_m) and np.array_equal(once.occupied, twice.occupied)
    assert np.array_equal(once.size_m, twice.size_m)


def test_scene_from_glb_round_trips_any_grid():
    grid = Grid(front_m=96.5, left_m=20.0, resolution_m=0.7, rows=30, cols=50)
    scene = replace(random_scene(2, grid=grid), ground_classes=("sidewalk", "crossing", "road", "ground", "terrain"))
    assert_same_scene(import_glb(export_glb(scene)), scene)


@pytest.mark.parametrize("stride", [2, 256])
def test_scene_from_glb_round_trips_isolated_pixels(stride):
    scene = random_scene(3, n=2)
    lonely = np.zeros_like(scene.occupied)
    lonely[2, ::stride, ::stride] = True
    scene = replace(scene, occupied=lonely, height_m=np.where(lonely, np.float32(0.37), np.float32(0)))
    assert_same_scene(import_glb(export_glb(scene)), scene)


def test_scene_from_glb_round_trips_empty_scene():
    scene = random_scene(0, n=0)
    scene = replace(scene, occupied=np.zeros_like(scene.occupied), height_m=np.zeros_like(scene.height_m))
    got = import_glb(export_glb(scene))
    assert len(got) == 0 and not got.occupied.any() and got.grid == scene.grid


def test_scene_from_glb_applies_node_transform():
    scene = replace(random_scene(4, n=3, tilt_rad=0.0), heading_rad=np.float32([0.1, 0.2, 0.3]))
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])

    def change(tree):
        node = next(node for node in tree["nodes"] if node["name"].endswith("_0001"))
        matrix = np.array(node["matrix"]).reshape(4, 4).T
        matrix[:3, :3] = turn @ matrix[:3, :3]
        matrix[0, 3] += 1.5
        node["matrix"] = matrix.T.ravel().tolist()

    got = import_glb(edit_glb(export_glb(scene), change), scene_id="edited")
    box = SIGNS * scene.size_m[1] @ (turn @ scene.rotation[1]).T + scene.center_m[1] + [1.5, 0, 0]
    apart = np.linalg.norm(compute_corners_m(got)[1][:, None] - box[None], axis=-1)
    assert apart.min(axis=0).max() < 1e-3 and apart.min(axis=1).max() < 1e-3
    assert np.isnan(got.heading_rad[1]) and np.array_equal(got.heading_rad[[0, 2]], scene.heading_rad[[0, 2]])
    assert got.scene_id == "edited"


# -------------------------------------------------------------------------------------------- format of the authors


def make_three_sphere() -> tuple[np.ndarray, np.ndarray]:
    """Return the sphere of three.js: 63 vertices (9 columns x 7 rows, radius 1, poles on y) and 80 triangles.

    Two of the vertices belong to no triangle.
    """
    u, v = np.meshgrid(np.arange(9) / 8 * 2 * np.pi, np.arange(7) / 6 * np.pi)
    vertices = np.stack([-np.cos(u) * np.sin(v), np.cos(v), np.sin(u) * np.sin(v)], axis=-1).reshape(-1, 3)
    faces = []
    for row in range(6):
        for col in range(8):
            b, a = 9 * row + col, 9 * row + col + 1
            c, d = b + 9, a + 9
            faces += [[a, b, d]] * (row > 0) + [[b, c, d]] * (row < 5)
    return vertices, np.array(faces)


def make_three_box() -> tuple[np.ndarray, np.ndarray]:
    """Return a box with eight vertices at ±0.5, in the order of KITTI-360, and twelve triangles."""
    corners = [
        [(1 if s == "+" else -1) / 2 for s in word] for word in ["+++", "++-", "+-+", "+--", "-+-", "-++", "---", "--+"]
    ]
    corners, faces = np.array(corners), []
    for axis in range(3):
        for side in (-0.5, 0.5):
            a, b, c, d = np.flatnonzero(corners[:, axis] == side)
            far = max((b, c, d), key=lambda k: np.linalg.norm(corners[k] - corners[a]))
            near = [k for k in (b, c, d) if k != far]
            faces += [[a, near[0], far], [a, far, near[1]]]
    return corners, np.array(faces)


def make_painted_mesh(vertices, faces, name: str | np.ndarray, linear: bool) -> trimesh.Trimesh:
    names = np.broadcast_to(name, len(vertices))
    color = np.array([parse_rgb(COLOR_HEX[n]) for n in names]) / 255
    if linear:
        color = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    rgba = np.hstack([np.round(255 * color), np.full((len(vertices), 1), 255)]).astype(np.uint8)
    return trimesh.Trimesh(vertices, faces, vertex_colors=rgba, process=False)


def make_authors_ground(scene: Scene, linear: bool) -> trimesh.Trimesh:
    height, winner = scene.surface()
    i, j = np.nonzero(winner >= 0)
    vertices = np.stack([64 - 0.25 * i, -32 + 0.25 * j, -height[i, j].astype(float)], axis=1)
    at = np.full((257, 257), -1)
    at[i, j] = np.arange(len(i))
    here, below, right, across = at[:-1, :-1], at[1:, :-1], at[:-1, 1:], at[1:, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((here, below, right), (right, below, across))])
    names = np.array(scene.ground_classes)[winner[i, j]]
    return make_painted_mesh(vertices, faces[(faces >= 0).all(axis=1)], names, linear)


def export_authors_glb(
    scene: Scene, merged: bool = False, linear: bool = False, unmerged: bool = False, faces: bool = False
) -> bytes:
    """Export a scene with trimesh in the format of the authors' files (docs/how_to/import_scenes.md)."""
    parts = [(make_authors_ground(scene, linear), np.eye(4))] if scene.occupied.any() else []
    for k, category in enumerate(scene.category):
        round_ = category == ELLIPSOID
        transform = np.eye(4)
        transform[:3, :3] = Z_DOWN @ scene.rotation[k] * scene.size_m[k] / (2 if round_ else 1)
        transform[:3, 3] = Z_DOWN @ scene.center_m[k]
        parts.append(
            (
                make_painted_mesh(*(make_three_sphere() if round_ else make_three_box()), CATEGORIES[category], linear),
                transform,
            )
        )
    if unmerged:
        for mesh, _ in parts:
            mesh.unmerge_vertices()
    if merged:
        whole = trimesh.util.concatenate([mesh.copy().apply_transform(transform) for mesh, transform in parts])
        if faces:
            color = whole.visual.vertex_colors[whole.faces[:, 0]]
            whole = trimesh.Trimesh(whole.vertices, whole.faces, face_colors=color, process=False)
        parts = [(whole, np.eye(4))]
    out = trimesh.Scene()
    for k, (mesh, transform) in enumerate(parts):
        out.add_geometry(mesh, geom_name=f"mesh{k}", transform=transform)
    return out.export(file_type="glb")


def assert_same_primitives(got: Scene, want: Scene) -> None:
    """Assert that the primitives match one to one in any order; boxes match by corners and ellipsoids match by
    shape."""
    assert np.array_equal(got.counts(), want.counts())
    left = list(range(len(got)))
    for k, corners in enumerate(compute_corners_m(want)):
        same = [i for i in left if got.category[i] == want.category[k]]
        nearest = min(
            same,
            key=lambda i: (
                np.abs(compute_scatter_m2(got)[i] - compute_scatter_m2(want)[k]).max()
                + np.linalg.norm(got.center_m[i] - want.center_m[k])
            ),
        )
        left.remove(nearest)
        assert np.linalg.norm(got.center_m[nearest] - want.center_m[k]) < 1e-3
        if want.category[k] == ELLIPSOID:
            assert np.abs(compute_scatter_m2(got)[nearest] - compute_scatter_m2(want)[k]).max() < 1e-3
        else:
            apart = np.linalg.norm(compute_corners_m(got)[nearest][:, None] - corners[None], axis=-1)
            assert apart.min(axis=0).max() < 1e-3 and apart.min(axis=1).max() < 1e-3
    rotation, size_m = canonicalize_boxes(got.rotation, got.size_m)
    assert np.allclose(rotation, got.rotation, atol=1e-5) and np.array_equal(size_m, got.size_m)


@pytest.mark.parametrize("merged", [False, True], ids=["instances", "merged"])
@pytest.mark.parametrize("linear", [False, True], ids=["sRGB", "linear"])
def test_scene_from_glb_reads_format_of_authors(town_scenes, merged, linear):
    scene = town_scenes[1]
    got = import_glb(export_authors_glb(scene, merged, linear))
    assert_same_primitives(got, scene)
    assert_same_ground(got, scene)
    assert got.source == "imported" and got.split == "generated" and got.grid == Grid()


@pytest.mark.parametrize("merged", [False, True])
def test_scene_from_glb_keeps_pitch_and_roll(merged):
    rng = np.random.default_rng(5)
    rotation, size_m = canonicalize_boxes(random_rotations(rng, 60), rng.choice([0.05, 0.5, 3, 14], (60, 3)))
    roll = trimesh.transformations.rotation_matrix(0.4, [1, 0, 0])[:3, :3]
    rotation, size_m = canonicalize_boxes(rotation @ roll, size_m)
    scene = replace(random_scene(5, n=60), rotation=rotation.astype(np.float32), size_m=size_m.astype(np.float32))
    assert_same_primitives(import_glb(export_authors_glb(scene, merged)), scene)


def test_scene_from_glb_reads_flat_shaded_files(town_scenes):
    scene = town_scenes[1].select(np.arange(20))
    assert {ELLIPSOID, *scene.category} > {ELLIPSOID}
    for merged in (False, True):
        got = import_glb(export_authors_glb(scene, merged, unmerged=True))
        assert_same_primitives(got, scene)
        isolated = got.occupied.any(axis=0) != scene.occupied.any(
            axis=0
        )  # a pixel that belongs to no triangle is not in the file
        assert isolated.sum() < 50


def test_scene_from_glb_mixes_face_colors_only_on_borders(town_scenes):
    scene = town_scenes[1]
    got = import_glb(export_authors_glb(scene, merged=True, faces=True))
    assert_same_primitives(got, scene)
    both = got.occupied.any(axis=0) & scene.occupied.any(axis=0)
    assert both.sum() > 0.99 * scene.occupied.any(axis=0).sum()
    assert np.array_equal(got.surface()[0][both], scene.surface()[0][both])
    assert (list_surface_classes(got) == list_surface_classes(scene))[both].mean() > 0.97


def test_scene_from_glb_reads_mesh_without_extras_by_shape(town_scenes):
    """Some editors drop the extras of a GLB, so the import must recognise the shapes.

    The file is an export of PrITTI on Ray with y up and vertices at pixel centres.
    """
    scene = town_scenes[1]

    def strip(tree):
        for entry in (*tree["scenes"], *tree["nodes"], *tree["meshes"]):
            entry.pop("extras", None)

    got = import_glb(edit_glb(export_glb(scene), strip), axes=("y+", "z+", "x+"))
    assert_same_primitives(got, scene)
    assert_same_ground(got, scene)


def test_scene_from_glb_takes_ids_from_file(tmp_path, town_scenes):
    (tmp_path / "scene-7.glb").write_bytes(export_authors_glb(town_scenes[0].select([0])))
    assert import_glb(tmp_path / "scene-7.glb").scene_id == "scene-7"
    assert import_glb(tmp_path / "scene-7.glb", "other").scene_id == "other"


# --------------------------------------------------------------------------------------- files of the paper's authors


def count_unit_meshes(path) -> dict[str, int]:
    """Count the primitives per colour from the numbers of vertices and triangles, as trimesh reads them.

    The authors place copies of two unit meshes: a box of 8 vertices and 12 triangles, and a sphere of 63 vertices and
    80 triangles. The number of boxes b and the number of spheres e of a colour follow from 8 b + 63 e and 12 b + 80 e.
    """
    mesh = trimesh.load(path, process=False, force="mesh")
    color = np.asarray(mesh.visual.vertex_colors)[:, :3]
    found = {}
    for name in CATEGORIES:
        painted = (color == parse_rgb(COLOR_HEX[name])).all(axis=1)
        sums = painted.sum(), painted[mesh.faces].all(axis=1).sum()
        boxes, spheres = np.linalg.solve([[8, 63], [12, 80]], sums)
        found[name] = round(spheres if name == "vegetation_ellipsoid" else boxes)
        assert np.allclose([boxes, spheres], np.round([boxes, spheres]))
    return found


@pytest.mark.parametrize("name", ["generated_low_0", "high_121", "low_12", "medium_240"])
def test_files_of_the_authors_give_count_of_unit_meshes(real_data, name):
    path = real_data / "glb" / f"{name}.glb"
    scene = import_glb(path)
    assert dict(zip(CATEGORIES, scene.counts().tolist(), strict=True)) == count_unit_meshes(path)
    assert scene.occupied.any(axis=0).mean() > 0.5 and scene.scene_id == name


def test_own_export_with_data_uri_equals_binary_chunk(town_scenes):
    glb = export_glb(town_scenes[0])
    size = int.from_bytes(glb[12:16], "little")
    text = base64.b64encode(glb[20 + size + 8 :]).decode()
    uri = f"data:application/octet-stream;base64,{text}"
    assert_same_scene(import_glb(edit_glb(glb[: 20 + size], lambda t: t["buffers"][0].update(uri=uri))), town_scenes[0])


# ------------------------------------------------------------------------------------------------------- faults


def export_mesh(vertices, faces, name: str = "vehicle_small") -> bytes:
    return trimesh.Scene(make_painted_mesh(np.asarray(vertices, float), faces, name, False)).export(file_type="glb")


def export_welded_boxes(name: str) -> bytes:
    """Return a GLB of two boxes that share a face and its vertices."""
    boxes = trimesh.creation.box(), trimesh.creation.box(bounds=[[0.5, -0.5, -0.5], [2, 0.5, 0.5]])
    whole = trimesh.util.concatenate(boxes)
    whole.merge_vertices()
    return export_mesh(whole.vertices, whole.faces, name)


def export_sheared_box() -> bytes:
    box = trimesh.creation.box()
    return export_mesh(box.vertices @ np.array([[1, 0.2, 0], [0, 1, 0], [0, 0, 1]]), box.faces)


def export_with_json(change) -> bytes:
    return edit_glb(export_glb(random_scene(6, n=2)), change)


def export_green_box() -> bytes:
    return trimesh.Trimesh(*make_three_box(), vertex_colors=[10, 200, 10, 255], process=False).export(file_type="glb")


FAULTS = {
    "text": (lambda: b"{}", "not a binary glTF"),
    "truncated": (lambda: export_glb(random_scene(6, n=2))[:-100], "expected a whole file"),
    "uri": (lambda: export_with_json(lambda t: t["buffers"][0].update(uri="http://x/y.bin")), "buffers lie outside"),
    "base64": (
        lambda: export_with_json(lambda t: t["buffers"][0].update(uri="data:application/octet-stream;base64,AA?A")),
        "buffer 0 is not valid base64",
    ),
    "plain": (lambda: export_with_json(lambda t: t["buffers"][0].update(uri="data:,AAAA")), "not valid base64"),
    "short": (
        lambda: export_with_json(lambda t: t["buffers"][0].update(uri="data:application/octet-stream;base64,AAAA")),
        "buffer 0 has 3 of",
    ),
    "buffer": (lambda: export_with_json(lambda t: t["buffers"].append({"byteLength": 4})), "buffer 1 has neither"),
    "image": (lambda: export_with_json(lambda t: t.update(images=[{"uri": "../x.png"}])), "images lie outside"),
    "draco": (lambda: export_with_json(lambda t: t.update(extensionsRequired=["KHR_draco_mesh_compression"])), "draco"),
    "cycle": (lambda: export_with_json(lambda t: t["nodes"][0].update(children=[0])), "two parents"),
    "beyond": (lambda: export_with_json(lambda t: t["accessors"][0].update(count=10**6)), "beyond its buffer"),
    "stride": (lambda: export_with_json(lambda t: t["bufferViews"][0].update(byteStride=0)), "beyond its buffer"),
    "many": (lambda: export_with_json(lambda t: t["accessors"][0].update(count=10**12)), "corners .* at most"),
    "missing": (lambda: export_with_json(lambda t: t.pop("accessors")), "the file has 0; export"),
    "number": (lambda: export_with_json(lambda t: t.update(nodes=7)), "'nodes' is 7, expected an array"),
    "grid": (
        lambda: export_with_json(lambda t: t["scenes"][0]["extras"]["grid"].update(rows=10**9)),
        "the grid .* pixels of all ground classes .* at most",
    ),
    "extras": (
        lambda: export_with_json(lambda t: t["nodes"][-1]["extras"].pop("label")),
        "extras of node .* are incomplete, because 'label' is missing",
    ),
    "nothing": (lambda: trimesh.Scene(trimesh.PointCloud([[0, 0, 0]])).export(file_type="glb"), "no class colour"),
    "colour": (export_green_box, r"colour #0ac80a \(sRGB\) of 8 vertices is no class colour"),
    "sheared": (export_sheared_box, "eight vertices that are not the corners of a box|edges are not perpendicular"),
    "welded": (lambda: export_welded_boxes("vehicle_small"), "more than eight vertices but is not vegetation"),
    "bush": (lambda: export_welded_boxes("vegetation_cuboid"), "neither on a box nor on an ellipsoid"),
    "ball": (
        lambda: export_mesh(*make_three_sphere(), "vehicle_small"),
        "more than eight vertices but is not vegetation",
    ),
    "flat": (lambda: export_mesh(make_three_box()[0] * [1, 1, 0], make_three_box()[1]), "thinner than 1 mm"),
    "triangle": (lambda: export_mesh(np.eye(3), [[0, 1, 2]]), "fewer than eight"),
    "nan": (lambda: export_mesh(np.full((8, 3), np.nan), make_three_box()[1]), "NaN"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_scene_from_glb_names_unknown_mesh_and_its_content(tmp_path, fault):
    make, words = FAULTS[fault]
    path = tmp_path / "theirs.glb"
    path.write_bytes(make())
    with pytest.raises(ValueError, match=rf"theirs\.glb: .*({words})"):
        import_glb(path)


def test_scene_from_glb_rejects_wrong_frame_and_axes(town_scenes):
    glb = export_authors_glb(town_scenes[0])
    with pytest.raises(ValueError, match=r"ground vertices, x .* are not one per pixel .*check the axes"):
        import_glb(glb, axes=("y+", "x+", "z+"))
    with pytest.raises(ValueError, match=r"axes 'x\+ x\+ z\+' are invalid; name x"):
        import_glb(glb, axes=("x+", "x+", "z+"))


def test_scene_from_glb_names_missing_file(tmp_path):
    with pytest.raises(ValueError, match=r"absent\.glb: cannot be read"):
        import_glb(tmp_path / "absent.glb")


def list_leaves(tree: dict | list) -> list[tuple]:
    """Return the pair (container, key) for every value in a JSON tree."""
    items = list(tree.items() if isinstance(tree, dict) else enumerate(tree))
    return [(tree, k) for k, _ in items] + [
        leaf for _, v in items if isinstance(v, dict | list) for leaf in list_leaves(v)
    ]


@pytest.mark.parametrize("make", [export_glb, export_authors_glb], ids=["ours", "theirs"])
def test_scene_from_glb_raises_only_value_error_for_mutated_json(make):
    grid = Grid(front_m=64.0, left_m=32.0, resolution_m=0.25, rows=8, cols=8)
    glb, rng = make(random_scene(7, n=4, grid=grid)), np.random.default_rng(0)
    values = [None, -1, 0, 10**6, 10**12, 10**400, 1e300, float("nan"), 0.5, True, "x", [], {}, [[1]], {"a": 1}]
    outcomes = {"scene": 0, "refused": 0}
    for _ in range(300):

        def change(tree):
            inside = list_leaves(tree)
            container, key = inside[rng.integers(len(inside))]
            container[key] = values[rng.integers(len(values))]

        try:
            import_glb(edit_glb(glb, change))
            outcomes["scene"] += 1
        except ValueError:
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 25


def test_scene_from_glb_of_authors_has_five_ground_classes(town_scenes):
    assert import_glb(export_authors_glb(town_scenes[0])).ground_classes == GROUND_CLASSES[:5]
