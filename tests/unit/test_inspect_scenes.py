"""Tests of the catalogue, of contact sheets and of the dataset page."""

import re
from collections import Counter
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers import REJECT_REASON, TOWN_SLOTS, SvgPage, random_scene
from scipy.spatial import ConvexHull

from jobs.implementation.inspect_scenes import draw_scenes, write_dataset_report
from jobs.inspect_scenes import OneScene, Report
from models.scene import CATEGORIES, ELLIPSOID, Grid
from pipelines.io.mesh_export import triangulate_cuboids, triangulate_ellipsoids
from pipelines.rendering.render import render_3d, render_bev
from pipelines.reporting.contact_sheet import RAMP, choose_columns, compute_footprints_m, draw_heights, draw_scene_plate
from pipelines.reporting.dataset_charts import MAX_NAMED, count_bins, draw_count_histogram, draw_track_map
from pipelines.reporting.dataset_report import read_facts, render_dataset_html
from pipelines.reporting.scene_index import Catalogue
from pipelines.runtime import storage
from pipelines.schema.tables import Shard


@pytest.fixture(scope="module")
def dataset_facts(town_dataset):
    return read_facts(town_dataset)


@pytest.fixture(scope="module")
def generated_dataset(tmp_path_factory):
    """Folder with four generated scenes. It contains no dataset.json, no poses and no vehicle labels."""
    root = str(tmp_path_factory.mktemp("inspect") / "generated")
    grid = Grid(rows=32, cols=32, resolution_m=2)
    fields = {"source": "generated-x", "split": "generated", "sequence": "0", "vegetation_density": "low", "grid": grid}
    scenes = [random_scene(k, 9, scene_id=f"generated-x-0-{k}", **fields) for k in range(4)]
    Shard(root, "generated-x", "generated", 0).write(scenes)
    storage.write_json({"model": "somewhere", "seed": 3}, f"{root}/generated-x.json")
    return root


# ----------------------------------------------------------------------------------------------------- choice of scenes


def test_catalogue_finds_scene_by_id(town_dataset):
    catalogue = Catalogue.read(town_dataset)
    names = catalogue.column("scene_id")
    found = catalogue.find([names[7], names[0]])
    assert found.tolist() == [7, 0] and len(catalogue) == 12
    loaded = {p: s for shard, rows, places in catalogue.chunks(found, 4) for p, s in zip(places, shard.scenes(rows))}  # noqa: B905
    assert [loaded[k].scene_id for k in (0, 1)] == [names[7], names[0]]
    assert loaded[0].split == "train" and len(loaded[0]) == catalogue.column("num_primitives")[7]


def test_catalogue_suggests_ids_for_unknown_id(town_dataset):
    catalogue = Catalogue.read(town_dataset)
    with pytest.raises(ValueError, match=r"no scene 'town-9' among 12 scenes; existing scenes include ") as error:
        catalogue.find(["town-9"])
    named = str(error.value).split("scenes include ")[1].split(", ")
    assert len(named) == 3 and set(named) <= set(catalogue.column("scene_id"))
    with pytest.raises(ValueError, match="existing scenes include ") as error:
        catalogue.find(["town-1000000"])
    assert all("town-1000000" in name for name in str(error.value).split("scenes include ")[1].split(", "))


@pytest.mark.parametrize("sort, column", [("vegetation", "vegetation_volume_m3"), ("num_pole", "num_pole")])
def test_catalogue_chooses_scenes_in_sorted_order(town_dataset, sort, column):
    catalogue = Catalogue.read(town_dataset)
    values = catalogue.column(column)
    ordered = np.sort(values)
    assert np.array_equal(values[catalogue.choose(99, sort)], ordered)
    assert np.array_equal(values[catalogue.choose(3, sort, "lowest")], ordered[:3])
    assert np.array_equal(values[catalogue.choose(3, sort, "highest")], ordered[::-1][:3])
    assert np.array_equal(values[catalogue.choose(4, sort)], ordered[[1, 4, 7, 10]])


def test_catalogue_chooses_scenes_evenly_or_randomly(town_dataset):
    catalogue = Catalogue.read(town_dataset)
    rows = list(zip(*(catalogue.column(n) for n in ("split", "sequence", "frame")), strict=True))
    assert [rows[k] for k in catalogue.choose(99, "drive")] == sorted(rows)
    drawn = catalogue.choose(5, "random", seed=1)
    assert len(set(drawn.tolist())) == 5 and np.array_equal(drawn, catalogue.draw(5, 1))
    assert not np.array_equal(drawn, catalogue.draw(5, 2))
    with pytest.raises(ValueError, match="--sort scene_id: expected drive, random, vegetation"):
        catalogue.choose(3, "scene_id")
    with pytest.raises(ValueError, match=r"no scene has a value in this column"):
        catalogue.choose(3, "crossing_area_m2")


# ------------------------------------------------------------------------------------------------------ pictures


def test_plate_shows_rendered_pictures(town_dataset):
    (scene,) = islice((s for s in Shard(town_dataset, "town", "test", 0).scenes()), 1)
    plate, boxes = draw_scene_plate(scene)
    assert set(boxes) == {"bev", "3d", "ground", "heights", "primitives"}
    bev, ground, oblique = boxes["bev"], boxes["ground"], boxes["3d"]
    assert np.array_equal(bev.of(plate), render_bev(scene, bev.width, supersample=2))
    assert np.array_equal(ground.of(plate), render_bev(scene.select([]), ground.width, supersample=2))
    assert np.array_equal(oblique.of(plate), render_3d(scene, oblique.width, oblique.height))
    covered = np.zeros(plate.shape[:2], int)
    for box in boxes.values():
        box.of(covered)[:] += 1
    assert covered.max() == 1 and covered.sum() == sum(b.width * b.height for b in boxes.values())


@pytest.mark.parametrize("rows, cols, n", [(64, 32, 20), (32, 64, 0)])
def test_plate_accepts_any_grid_and_empty_scene(rows, cols, n):
    scene = random_scene(0, n, Grid(front_m=64, left_m=cols / 2, resolution_m=1, rows=rows, cols=cols))
    if n == 0:
        scene = replace(scene, occupied=np.zeros_like(scene.occupied), height_m=np.zeros_like(scene.height_m))
    plate, boxes = draw_scene_plate(scene)
    assert plate.shape == draw_scene_plate(random_scene(1, 3))[0].shape
    assert boxes["bev"].height / boxes["bev"].width == rows / cols
    assert np.array_equal(boxes["bev"].of(plate), render_bev(scene, max(boxes["bev"][2:]), supersample=2))


def test_plate_draws_heights_on_color_scale():
    scene = random_scene(0, 0, Grid(resolution_m=1, rows=64, cols=64))
    picture, (low, high) = draw_heights(scene, 64)
    surface, winner = scene.surface()
    known = winner >= 0
    assert np.allclose([low, high], np.percentile(surface[known], [1, 99]))
    assert (picture[~known] == 255).all() and not (picture[known] == 255).all(axis=-1).any()
    assert (picture[known & (surface <= low)] == RAMP[0]).all() and (
        picture[known & (surface >= high)] == RAMP[-1]
    ).all()
    order = surface[known].argsort()
    assert (
        np.diff(picture[known].astype(int)[order][:, 1]) >= 0
    ).all()  # the green channel increases along the colour scale


def test_plate_footprints_equal_mesh_projections():
    scene = random_scene(3, 60, tilt_rad=1.2)
    outlines = compute_footprints_m(scene)
    for triangles, tolerance in ((triangulate_cuboids(scene), 1e-4), (triangulate_ellipsoids(scene), 0.03)):
        for k in np.unique(triangles.primitive):
            shadow = ConvexHull(triangles.corners_m[triangles.primitive == k][..., :2].reshape(-1, 2))
            ours = ConvexHull(outlines[k])
            assert np.isclose(ours.volume, shadow.volume, rtol=tolerance)
            low, high = (f(outlines[k], axis=0) - f(shadow.points, axis=0) for f in (np.min, np.max))
            assert np.abs([low, high]).max() < max(tolerance, 1e-4) * np.ptp(shadow.points)
    assert (scene.category == ELLIPSOID).any()


@pytest.mark.parametrize("count, aspect", [(1, 1), (7, 1), (64, 1), (48, 4 / 3), (1000, 1)])
def test_sheet_has_aspect_ratio_of_five_to_four(count, aspect):
    columns = choose_columns(count, aspect)
    assert 1 <= columns <= count
    if count >= 48:
        assert 0.6 < columns * aspect / -(-count // columns) < 2.2


# ------------------------------------------------------------------------------------------------------ the page


def find_histogram_titles(svg):
    return [int(n) for n in re.findall(r"<title>[^<]*: (\d+) scenes</title>", svg)]


@pytest.mark.parametrize("counts", [[0, 0, 1], [3], list(range(100)), [0, 514, 514, 7]])
def test_histograms_count_every_scene_once(counts):
    counts = np.array(counts)
    width, scenes = count_bins(counts)
    assert scenes.sum() == len(counts)
    assert np.array_equal(scenes, np.histogram(counts, np.arange(len(scenes) + 1) * width)[0])
    assert sum(find_histogram_titles(draw_count_histogram("pole", counts, {"p95": 3, "slots": 5}))) == len(counts)


def test_dataset_page_is_well_formed_and_self_contained(dataset_facts):
    html = render_dataset_html(dataset_facts)
    page = SvgPage(html)
    assert not re.search(r"https?:|//[a-z]|@import", re.sub(r"base64,[A-Za-z0-9+/=]+", "", html))
    assert not page.all("script") and not page.all("link")
    assert "[drawings of section" not in html
    for text in (
        "12",
        "8 train, 4 test",
        REJECT_REASON,
        "town-00000-0000000001",
        "bridge",
        "sheared flat",
        "beyond> 327 m",
    ):
        assert text in page.text


def test_dataset_page_states_table_contents(dataset_facts, town_dataset):
    html = render_dataset_html(dataset_facts)
    scenes = [s for shard in Catalogue.read(town_dataset).shards for s in shard.scenes()]
    for k, name in enumerate(CATEGORIES):
        counts = np.array([s.counts()[k] for s in scenes])
        drawn = re.findall(rf'<svg[^>]*aria-label="scenes by number of {name.replace("_", " ")}".*?</svg>', html)
        assert len(drawn) == (counts.any() or name in TOWN_SLOTS)
        assert all(sum(find_histogram_titles(svg)) == len(scenes) for svg in drawn)
        if counts.any():
            sizes = np.concatenate([s.size_m[s.category == k] for s in scenes])
            assert np.array_equal(np.sort(dataset_facts.sizes_m[name], axis=0), np.sort(sizes, axis=0))
    for name, slots in TOWN_SLOTS.items():
        counts = [s.counts()[CATEGORIES.index(name)] for s in scenes if s.split == "train"]
        p95 = max(1, int(np.ceil(np.percentile(counts, 95))))
        svg = re.search(rf'aria-label="scenes by number of {name.replace("_", " ")}".*?</svg>', html).group()
        assert f">slots {slots}<" in svg and f">p95 {p95}<" in svg
    total = sum(dataset_facts.labels.values())
    assert total == sum(map(len, scenes)) == sum(map(len, dataset_facts.sizes_m.values()))


def test_dataset_page_ground_shares_and_labels_add_up(dataset_facts, town_dataset):
    html = render_dataset_html(dataset_facts)
    low = [s for shard in Catalogue.read(town_dataset).shards for s in shard.scenes() if s.vegetation_density == "low"]
    share = np.mean([s.occupied[0].mean() for s in low])
    svg = re.search(r'aria-label="by vegetation density".*?</svg>', html).group()
    assert f">{100 * share:.1f} %<" in svg
    cells = re.findall(r"<title>(low|medium|high), (low|medium|high): (\d+) scenes</title>", html)
    assert len(cells) == 2 * 9 and sum(int(n) for *_, n in cells) == 12
    assert sum(int(n) for vegetation, _, n in cells if vegetation == "low") == len(low) == 3


def test_dataset_map_has_one_dot_per_scene(dataset_facts):
    catalogue = dataset_facts.catalogue
    paths = re.findall(r'data-split="(\w+)" d="([^"]*)"', render_dataset_html(dataset_facts))
    dots = {split: np.array(re.findall(r"M([-\d.]+) ([-\d.]+)h0", d), float) for split, d in paths}
    assert {split: len(d) for split, d in dots.items()} == Counter(catalogue.column("split"))
    rows = (catalogue.column("split") == "test").nonzero()[0]
    world = np.stack([catalogue.column("x_m"), catalogue.column("y_m")], axis=1)[rows]
    world -= world.mean(axis=0)
    drawn = (dots["test"] - dots["test"].mean(axis=0)) * [1, -1]
    scale = np.abs(drawn).max() / np.abs(world).max()
    assert np.allclose(drawn, scale * world, atol=0.15)  # the map is to scale; coordinates have one decimal


@pytest.mark.parametrize("sequences", [1, 9, MAX_NAMED + 1, 1000])
def test_dataset_maps_of_many_sequences_fit_page(sequences):
    rng = np.random.default_rng(sequences)
    tracks = {
        f"{k:05d}": {"train": rng.uniform(0, rng.uniform(1, 900, 2), (7, 2)) + 4000, "unused": np.full((1, 2), 4100.0)}
        for k in range(sequences)
    }
    svg = draw_track_map(tracks)
    width, height = map(float, re.search(r'viewBox="0 0 (\d+) (\d+)"', svg).groups())
    dots = np.array(re.findall(r"M([-\d.]+) ([-\d.]+)h0", svg), float)
    assert len(dots) == 8 * sequences and height < 2100
    assert (dots >= 0).all() and (dots <= [width, height]).all()
    frames = np.array(
        re.findall(r'<rect x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)" rx="6"', svg), float
    )
    low, high = frames[:, :2], frames[:, :2] + frames[:, 2:]
    assert len(frames) == sequences and (high <= [width, height]).all()
    apart = (low[:, None] >= high[None] - 0.11).any(axis=2)
    assert (apart | apart.T | np.eye(sequences, dtype=bool)).all()


def test_dataset_page_works_without_dataset_json(generated_dataset, tmp_path):
    path = write_dataset_report(Report(dataset=generated_dataset, num_examples=0, output=str(tmp_path / "page.html")))
    page = SvgPage(Path(path).read_text("utf-8"))
    assert "4 generated" in page.text and "somewhere" in page.text
    for absent in ("p95", "slots", "Split map", "Thresholds of density labels", "Rejected"):
        assert absent not in page.text
    cells = re.findall(r"<title>(\w+), (\w+): (\d+) scenes</title>", Path(path).read_text("utf-8"))
    assert ("low", "none", "4") in cells and len(cells) == 12


# -------------------------------------------------------------------------------------------------------- the job


def test_draw_scenes_runs_without_ray(generated_dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("jobs.implementation.inspect_scenes.start_ray", None)
    written = draw_scenes(OneScene(dataset=generated_dataset, max_scenes=2, seed=1, glb=True, output=str(tmp_path)))
    assert sorted(path.rsplit(".", 1)[1] for path in written) == ["glb", "glb", "png", "png"]
    names = [path.rsplit("/", 1)[1].removesuffix(".png") for path in written if path.endswith(".png")]
    assert set(names) <= {f"generated-x-0-{k}" for k in range(4)} and len(set(names)) == 2
    nodes = trimesh.load(f"{tmp_path}/{names[0]}.glb").graph.nodes
    assert sum(re.fullmatch(r"[a-z_]+_\d{4}", node) is not None for node in nodes) == 9
    (again,) = draw_scenes(OneScene(ids=(names[0],), dataset=generated_dataset, output=str(tmp_path / "again")))
    assert Path(again).read_bytes() == (tmp_path / f"{names[0]}.png").read_bytes()
    with pytest.raises(ValueError, match="--max-scenes is 0, expected at least 1"):
        draw_scenes(OneScene(dataset=generated_dataset, max_scenes=0))
    with pytest.raises(ValueError, match="holds no split=test; it holds source="):
        draw_scenes(OneScene(dataset=generated_dataset, split="test"))
