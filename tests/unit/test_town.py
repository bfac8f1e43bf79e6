"""Tests of the town generator: statistics of KITTI-360, valid geometry and the KITTI-360 format."""

import subprocess
import sys
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
import shapely

from models.scene import CATEGORIES, CATEGORY_INDEX, Grid
from pipelines.preprocess.sources import kitti360
from pipelines.preprocess.sources.drive import STATIC
from pipelines.preprocess.sources.town.generator import (
    DISTRICTS,
    TEST_SEEDS_START,
    TOWN_VERSIONS,
    TRAIN_SEEDS_START,
    generate_town,
    plan_town_parts,
    select_poses,
    write_kitti360,
)
from pipelines.preprocess.sources.town.land import clip_ears, trace_outlines
from pipelines.preprocess.sources.town.reference_statistics import (
    COUNT_TOLERANCE,
    COUNT_TOLERANCE_SMALL,
    make_sample,
    measure_town,
)

SMALL = Grid(resolution_m=1.0, rows=64, cols=64)


@pytest.fixture(
    scope="module",
    params=[pytest.param(version, marks=[pytest.mark.slow] if version == 1 else []) for version in TOWN_VERSIONS],
    ids=lambda version: f"version {version}",
)
def version(request):
    return request.param


@pytest.fixture(scope="module")
def drives(version):
    return [generate_town(seed, version) for seed in range(4)]


@pytest.fixture(scope="module")
def large_sample(version):
    """Counts of 1,000 test scenes, the relief (m) of every tenth scene, and the town of each scene."""
    relief, towns = [], []

    def scenes():
        for seed, split, count in plan_town_parts(num_train=0, num_test=1_000):
            drive = generate_town(seed, version)
            for k, index in enumerate(select_poses(len(drive), count)):
                scene = drive.scene(int(index), split)
                if k % 10 == 0:
                    relief.append(np.ptp(scene.surface()[0][scene.occupied.any(axis=0)]))
                towns.append(seed)
                yield scene

    return make_sample(scenes()), np.array(relief), np.array(towns)


def find_missed_targets(sample, towns) -> list[str]:
    """List the targets that the towns miss by more than their tolerance and two standard errors of mean counts.

    The scenes of a town are not independent, so a mean over a few towns has a large error: two-wheelers of label high
    have 2.0 per scene here, and 1.55 in 4,720 such scenes of 200 other towns (target 1.5).
    """
    labels, missed = sample.labels(), []
    for row in measure_town(sample):
        tolerance = 0.0
        if row.what.startswith("mean count "):
            here, index = labels == row.label, CATEGORIES.index(row.what.removeprefix("mean count "))
            off = np.bincount(np.unique(towns, return_inverse=True)[1], here * (sample.counts[:, index] - row.measured))
            tolerance = COUNT_TOLERANCE_SMALL if row.target < 3 else COUNT_TOLERANCE * row.target
            tolerance += 2 * np.sqrt((off**2).sum()) / here.sum()
        if not row.ok and not abs(row.measured - row.target) <= tolerance:
            missed.append(f"{row.what} ({row.label}): {row.measured:.2f}, target {row.target:g}")
    return missed


@pytest.mark.slow
def test_town_scenes_have_target_statistics(large_sample):
    sample, _, towns = large_sample
    assert len(sample.counts) == 1_000
    missed = find_missed_targets(sample, towns)
    assert not missed, "\n".join(missed)
    # The test can fail: with 1.5 times the objects, most counts miss their targets.
    more = replace(sample, counts=sample.counts * 3 // 2)
    assert len(find_missed_targets(more, towns)) > 12


@pytest.mark.slow
def test_town_counts_are_overdispersed_with_every_category(large_sample, version):
    counts = large_sample[0].counts
    dispersion = dict(zip(CATEGORIES, counts.var(axis=0) / counts.mean(axis=0), strict=True))
    assert (counts.sum(axis=0) > 0).all()
    for name in ("vegetation_cuboid", "vegetation_ellipsoid", "construction_small", "object"):
        assert dispersion[name] > (2.5 if (version, name) == (2, "object") else 3), (name, dispersion)
    for name in ("vehicle_small", "two_wheelers", "human", "pole", "traffic_control"):
        # The poles of version 2 stand at regular distances.
        assert dispersion[name] > (0.8 if (version, name) == (2, "pole") else 1.3), (name, dispersion)
    assert dispersion["construction_big"] > 1, dispersion


@pytest.mark.slow
def test_town_vegetation_and_relief_are_in_stated_ranges(large_sample):
    """Per label, the medians of count and volume are within the stated ranges (p05 to p95). The tails are close to the
    ranges."""
    sample, relief, _ = large_sample
    label = sample.labels()
    for which, count_range, volume_range in (
        ("low", (13, 36), (700, 8_000)),
        ("medium", (78, 227), (5_000, 21_000)),
        ("high", (152, 310), (19_000, 49_000)),
    ):
        for values, (low, high) in (
            (sample.vegetation_count[label == which], count_range),
            (sample.vegetation_volume_m3[label == which], volume_range),
        ):
            p05, p50, p95 = np.percentile(values, [5, 50, 95])
            assert low <= p50 <= high, (which, p50)
            assert 0.6 * low < p05 and p95 < 1.8 * high, (which, p05, p95)
    assert 1.0 < np.median(relief) < 2.0


def test_town_depends_on_seed(drives, version):
    again = generate_town(1, version)
    for name in ("center_m", "rotation", "size_m", "category", "timestamp", "frame", "world_from_imu", "instance_id"):
        assert np.array_equal(getattr(again, name), getattr(drives[1], name)), name
    assert np.array_equal(again.ground.vertices_m, drives[1].ground.vertices_m)
    assert (again.label == drives[1].label).all()
    assert len({len(drive.category) for drive in drives}) == len(drives)


def test_town_poses_are_ten_meters_apart(drives):
    for drive in drives:
        xy = drive.world_from_imu[:, :2, 3]
        distance = np.linalg.norm(xy[:, None] - xy[None], axis=2) + 1e9 * np.eye(len(xy))
        assert distance.min() >= 10.0
        assert 200 <= len(drive) <= 256
        assert (np.diff(drive.frame) > 0).all()


def test_town_imu_is_above_road_with_z_down_and_small_tilt(drives):
    for drive in drives:
        rotation = drive.world_from_imu[:, :, :3]
        assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-9)
        assert np.allclose(np.linalg.det(rotation), 1.0)
        tilt = np.degrees(np.arccos(-rotation[:, 2, 2]))
        assert tilt.max() < 8
        for index in range(0, len(drive), 40):
            scene = drive.scene(index, grid=Grid(front_m=32.0))
            road = scene.ground_classes.index("road")
            assert scene.occupied[road, 126:130, 126:130].all()  # The ego vehicle is on a road.
            # The tops of slabs are 0.3 m and the IMU is 0.93 m above the true surface.
            assert abs(scene.height_m[road, 128, 128] + 0.63) < 0.06


def test_town_cars_stand_on_surface_near_roads(drives):
    gaps, near, total = [], 0, 0
    for drive in drives[:2]:
        for index in range(0, len(drive), 12):
            scene = drive.scene(index)
            top, ground_class = scene.surface()
            cars = scene.category == CATEGORY_INDEX["vehicle_small"]
            row, col = scene.grid.pixel(scene.center_m[cars, 0], scene.center_m[cars, 1])
            keep = ground_class[row, col] >= 0
            bottom = scene.center_m[cars, 2] - scene.size_m[cars, 2] / 2
            gaps.append((bottom - (top[row, col] - 0.3))[keep])
            lanes = scene.occupied[scene.ground_classes.index("road")]
            for r, c in zip(row, col, strict=True):
                total += 1
                near += lanes[max(0, r - 12) : r + 13, max(0, c - 12) : c + 13].any()
    gaps = np.concatenate(gaps)
    assert np.percentile(np.abs(gaps), 98) < 0.12
    assert near / total > 0.7  # all other cars are on driveways and car parks


def test_town_moving_objects_avoid_parked_ones(drives):
    vehicles = [CATEGORY_INDEX["vehicle_small"], CATEGORY_INDEX["vehicle_big"]]
    for drive in drives:
        is_vehicle = np.isin(drive.category, vehicles)
        parked = np.flatnonzero(is_vehicle & (drive.timestamp == STATIC))
        for k in np.flatnonzero(is_vehicle & (drive.timestamp != STATIC)):
            near = parked[np.linalg.norm(drive.center_m[parked, :2] - drive.center_m[k, :2], axis=1) < 1.8]
            assert len(near) == 0


def test_town_streets_are_connected(drives):
    """All road slabs belong to one connected component."""
    for drive in drives:
        ground = drive.ground
        roads = np.flatnonzero(ground.slab_class == drive.ground_classes.index("road"))
        polygons = []
        for slab in roads:
            vertices = ground.vertices_m[ground.vertex_slab == slab]
            polygons.append(shapely.Polygon(vertices[: len(vertices) // 2, :2]).buffer(0.05))
        tree = shapely.STRtree(polygons)
        a, b = tree.query(polygons, predicate="intersects")
        reached, queue = {0}, deque([0])
        while queue:
            here = queue.popleft()
            for there in b[a == here].tolist():
                if there not in reached:
                    reached.add(there)
                    queue.append(there)
        assert len(reached) == len(polygons)


def test_town_slabs_are_closed_simple_and_disjoint(drives):
    drive = drives[0]
    ground = drive.ground
    areas, polygons, corners = {name: [] for name in drive.ground_classes}, [], []
    for slab, index in enumerate(ground.slab_class):
        vertices = ground.vertices_m[ground.vertex_slab == slab]
        n = len(vertices) // 2
        faces = ground.triangles[ground.vertex_slab[ground.triangles[:, 0]] == slab]
        assert 4 <= n <= 40 and len(faces) == 4 * n - 4
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()  # the slab is closed
        assert np.allclose(vertices[:n, 2] - vertices[n:, 2], 0.6)
        outline = shapely.Polygon(vertices[:n, :2])
        assert outline.is_valid
        tops = ground.vertices_m[faces[: n - 2], :2]
        e, f = tops[:, 1] - tops[:, 0], tops[:, 2] - tops[:, 0]
        filled = np.abs(e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]).sum() / 2
        assert abs(filled - outline.area) < 1e-6
        areas[drive.ground_classes[index]].append(outline.area)
        polygons.append(outline)
        corners.append(n)
    union = shapely.union_all([polygon.buffer(-0.02) for polygon in polygons])
    total = sum(polygon.area for polygon in polygons)
    assert union.area > 0.97 * total  # slabs overlap only at bends or because of rounding
    assert 120 < np.median(areas["road"]) < 320
    assert 10 < np.median(areas["sidewalk"]) < 35
    assert 0.15 < np.mean(np.array(corners) == 4) < 0.6


def test_town_grade_is_at_most_three_percent(drives):
    for drive in drives:
        for slab in np.flatnonzero(drive.ground.slab_class == 0):
            top = drive.ground.vertices_m[drive.ground.vertex_slab == slab]
            top = top[: len(top) // 2]
            run = np.linalg.norm(np.diff(top[:, :2], axis=0), axis=1)
            assert (np.abs(np.diff(top[:, 2])) <= 0.0301 * run + 1e-9).all()


def test_ear_clipping_tiles_random_outlines():
    rng = np.random.default_rng(0)
    for n in [3, 4, 5, 8, 13, 40] * 20:
        angle = np.sort(rng.uniform(0, 2 * np.pi, n))
        if np.diff(angle, append=angle[0] + 2 * np.pi).max() > 3:
            continue
        outline = rng.uniform(1, 9, (n, 1)) * np.column_stack([np.cos(angle), np.sin(angle)])
        triangles = clip_ears(outline)
        assert len(triangles) == n - 2
        signed = [np.linalg.det(np.diff(outline[list(t)], axis=0)) / 2 for t in triangles]
        assert min(signed) > -1e-6
        assert np.isclose(sum(signed), shapely.Polygon(outline).area)


def test_cell_outlines_equal_unions():
    rng = np.random.default_rng(1)
    s, t = [0.0, 1.0, 2.5, 4.0, 7.0], [0.0, 2.0, 3.0, 5.5]
    for _ in range(60):
        cells = rng.integers(-1, 2, (4, 3))
        for value in (0, 1):
            boxes = [shapely.box(s[i], t[j], s[i + 1], t[j + 1]) for i, j in np.argwhere(cells == value).tolist()]
            union = shapely.union_all(boxes)
            parts = [union] if union.geom_type == "Polygon" else list(getattr(union, "geoms", []))
            if any(len(part.interiors) for part in parts):
                continue
            found = [shapely.Polygon(outline) for v, outline in trace_outlines(cells, s, t) if v == value]
            assert np.isclose(sum(p.area for p in found), union.area)
            assert np.isclose(shapely.union_all(found).area, union.area)


def test_plan_town_covers_request_with_different_towns():
    for num_train, num_test in ((10_000, 1_000), (48, 16), (1, 1), (0, 5), (257, 0)):
        plan = plan_town_parts(num_train, num_test)
        for split, wanted in (("train", num_train), ("test", num_test)):
            assert sum(count for _, s, count in plan if s == split) == wanted
        assert len({seed for seed, _, _ in plan}) == len(plan)
        assert all(1 <= count <= 200 for _, _, count in plan)
        assert all((seed >= TEST_SEEDS_START) == (split == "test") for seed, split, _ in plan)
        assert all(seed >= TRAIN_SEEDS_START for seed, _, _ in plan)
    assert len([1 for _, split, _ in plan_town_parts(48, 16) if split == "train"]) >= 8
    with pytest.raises(ValueError, match="-3"):
        plan_town_parts(num_train=-3)


def test_select_poses_spreads_over_drive():
    assert select_poses(250, 250).tolist() == list(range(250))
    some = select_poses(251, 7)
    assert len(set(some)) == 7 and some[0] < 30 and some[-1] > 220
    assert select_poses(5, 0).tolist() == []
    with pytest.raises(ValueError, match="9 scenes"):
        select_poses(8, 9)


def test_plan_town_shows_every_density_when_small():
    labels = []
    for seed, split, count in plan_town_parts(48, 0):
        drive = generate_town(seed)
        labels += [
            drive.scene(int(index), split, SMALL).counts()[:2].sum() for index in select_poses(len(drive), count)
        ]
    assert np.percentile(labels, 10) < 60 and np.percentile(labels, 90) > 150
    assert set(DISTRICTS) == {"centre", "suburb", "green"}


def test_town_round_trips_kitti360_format(tmp_path, drives):
    drive = drives[2]
    write_kitti360(drive, tmp_path, defects=True, seed=3)
    name = kitti360.list_sequences(tmp_path)
    assert name == ["0002"]
    read, report = kitti360.read_drive(tmp_path, name[0])
    assert report.duplicates > 50 and sum(report.dropped.values()) == 12
    assert not report.unknown and not report.defects
    assert len(read.category) == len(drive.category) and len(read.ground.slab_class) == len(drive.ground.slab_class)
    assert np.array_equal(read.frame, drive.frame)
    assert np.abs(read.world_from_imu - drive.world_from_imu).max() < 1e-6
    for index in range(0, len(drive), 37):
        ours, theirs = drive.scene(index), read.scene(index)
        a = np.lexsort((ours.instance_id, ours.category))
        b = np.lexsort((theirs.instance_id, theirs.category))
        assert np.array_equal(ours.category[a], theirs.category[b])
        assert np.array_equal(ours.instance_id[a], theirs.instance_id[b])
        assert (ours.label[a] == theirs.label[b]).all()
        assert np.abs(ours.center_m[a] - theirs.center_m[b]).max() < 1e-3
        scatter = [(s.rotation * s.size_m[:, None, :]) @ s.rotation.transpose(0, 2, 1) for s in (ours, theirs)]
        assert np.abs(scatter[0][a] - scatter[1][b]).max() < 5e-3
        turn = ours.heading_rad[a] - theirs.heading_rad[b]
        known = np.isfinite(ours.heading_rad[a])
        assert np.array_equal(known, np.isfinite(theirs.heading_rad[b]))
        assert np.abs(np.exp(1j * turn[known]) - 1).max(initial=0) < 1e-2
        assert (ours.occupied != theirs.occupied).mean() < 1e-4
        both = ours.occupied & theirs.occupied
        assert np.percentile(np.abs(ours.height_m - theirs.height_m)[both], 99.9) < 1e-3


def test_town_without_defects_writes_objects_once(tmp_path, drives):
    write_kitti360(drives[1], tmp_path, defects=False)
    read, report = kitti360.read_drive(tmp_path, "0001")
    assert report.duplicates == 0 and not report.dropped
    assert np.array_equal(read.instance_id, drives[1].instance_id)
    assert np.abs(read.size_m - drives[1].size_m).max() < 1e-5


def test_town_import_needs_numpy_only():
    heavy = ["ray", "pyarrow", "shapely", "trimesh", "torch", "scipy", "PIL"]
    code = f"import sys, pipelines.preprocess.sources.town.generator; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
