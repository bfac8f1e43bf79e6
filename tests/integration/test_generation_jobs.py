"""Tests of the generation jobs on Ray with the smoke presets: resuming, actors, killed processes and scores."""

import json
from dataclasses import replace
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import trimesh
from helpers import kill_ray_workers, tiny_planner
from osm_map import LATITUDE, LONGITUDE, make_town_street
from PIL import Image
from scipy.spatial import cKDTree

from models.scene import CATEGORY_INDEX, DENSITIES, Scene
from pipelines.runtime import storage
from pipelines.schema.tables import find_shards, read_scenes


@pytest.fixture(scope="session")
def samples(smoke) -> Path:
    from jobs.implementation.sample_scenes import sample
    from jobs.sample_scenes import Config

    model, output = str(smoke / "models/pritti-smoke"), smoke / "generated"
    sample(Config(model=model, output=str(output), num_scenes=9, num_inference_steps=10, batch_size=8, num_glb=1))
    return output


def test_sample_is_independent_of_actors_and_batch_size(smoke, samples, tmp_path):
    from jobs.implementation.sample_scenes import sample
    from jobs.sample_scenes import Config
    from models.tensors import EXISTENCE_THRESHOLD

    model = str(smoke / "models/pritti-smoke")
    sample(Config(model=model, output=str(tmp_path), num_scenes=9, num_inference_steps=10, batch_size=1, num_actors=2))
    a, b = list(read_scenes(str(samples))), list(read_scenes(str(tmp_path)))
    assert [s.scene_id for s in a] == [s.scene_id for s in b] and len(a) == 9
    assert [s.vegetation_density for s in a] == [*DENSITIES] * 3
    for one, other in zip(a, b, strict=True):
        sure = [s.select(np.abs(s.existence - EXISTENCE_THRESHOLD) > 1e-3) for s in (one, other)]
        assert np.array_equal(sure[0].category, sure[1].category)
        assert np.allclose(sure[0].center_m, sure[1].center_m, atol=0.01)
        assert (one.occupied == other.occupied).mean() > 0.999


def test_sample_resumes_interrupted_run(smoke, samples):
    from jobs.implementation.sample_scenes import sample
    from jobs.sample_scenes import Config

    shards = find_shards(str(samples))
    before = [s.scene_id for s in read_scenes(str(samples))]
    kept, lost = Path(shards[0].path("scenes")), Path(shards[1].path("rasters"))
    stamp = kept.stat().st_mtime_ns
    lost.unlink()
    damaged = [Path(shards[2].path("primitives")), Path(shards[3].path("scenes"))]
    contents = [path.read_bytes() for path in damaged]
    damaged[0].write_bytes(contents[0][:-100])
    pq.write_table(pq.read_table(damaged[1], partitioning=None).slice(1), damaged[1])
    config = Config(
        model=str(smoke / "models/pritti-smoke"),
        output=str(samples),
        num_scenes=9,
        num_inference_steps=10,
        batch_size=8,
    )
    sample(config)
    assert kept.stat().st_mtime_ns == stamp and lost.exists()
    assert [path.read_bytes() for path in damaged] == contents
    assert [s.scene_id for s in read_scenes(str(samples))] == before
    with pytest.raises(ValueError, match="with seed=0, asked for 5"):
        sample(replace(config, seed=5))
    with pytest.raises(ValueError, match=r"with existence_threshold=0.3, asked for 0.5"):
        sample(replace(config, existence_threshold=0.5))
    with pytest.raises(ValueError, match="unknown to a vegetation model, expected one of: low, medium, high"):
        sample(replace(config, run="x", labels=("dense",)))


def test_sample_passes_repair_option(smoke, tmp_path, monkeypatch):
    from jobs.implementation.sample_scenes import sample
    from jobs.sample_scenes import Config

    requests = []
    monkeypatch.setattr("jobs.implementation.sample_scenes.sample_scenes", lambda request, *_: requests.append(request))
    for repair in (False, True):
        sample(Config(str(smoke / "models/pritti-smoke"), output=str(tmp_path), num_scenes=1, num_glb=0, repair=repair))
    assert [request.repair for request in requests] == [False, True]


@pytest.mark.slow
def test_sweep_samplers_scores_each_sampler_and_resumes(smoke, tmp_path):
    from jobs.implementation.sweep_samplers import sweep_samplers
    from jobs.sweep_samplers import Config

    config = Config(
        model=str(smoke / "models/pritti-smoke"),
        real=str(smoke / "datasets/smoke"),
        samplers=("dpm++",),
        num_inference_steps=(2,),
        num_scenes=6,
        num_examples=2,
        output=str(tmp_path),
    )
    *rows, ceiling, control = sweep_samplers(config)
    assert [(row["sampler"], row["steps"], row["scenes"]) for row in rows] == [("dpm++", 2, 6)]
    assert all(row["layout_frechet_low"] <= row["layout_frechet"] and row["seconds_per_scene"] > 0 for row in rows)
    assert {scene.source for scene in read_scenes(str(tmp_path))} == {"generated-dpm++-2"}
    assert (tmp_path / "samplers.html").read_text().count("<img") == 2
    assert "<svg" in (tmp_path / "samplers-layout_frechet.svg").read_text()
    assert ceiling["relation_frechet"] < control["relation_frechet_low"]
    assert ceiling["steps"] is control["steps"] is None
    rows += [ceiling, control]
    assert sweep_samplers(config) == rows  # the second call samples no scenes
    found = duckdb.sql(f"select layout_frechet from '{tmp_path}/samplers.parquet'").fetchall()
    assert [value for (value,) in found] == [row["layout_frechet"] for row in rows]
    with pytest.raises(ValueError, match=r"--samplers euler: expected some of ddpm, ddim, dpm\+\+"):
        sweep_samplers(replace(config, samplers=("euler",)))
    with pytest.raises(ValueError, match=r"--ceiling-split test .* has 16 scenes, but the ceiling needs 20"):
        sweep_samplers(replace(config, real_split="train", num_scenes=20))
    guided = replace(config, guidance_scale=(1.0, 2.0), num_examples=0, output=str(tmp_path / "guided"))
    assert [row["guidance_scale"] for row in sweep_samplers(guided)] == [1, 2, None, None]
    assert "<svg" in (tmp_path / "guided/samplers-vegetation_fidelity.svg").read_text()


def test_sample_glb_has_named_node_per_primitive(samples):
    scene = next(read_scenes(str(samples)))
    path = samples / "glb/samples" / f"{scene.scene_id}.glb"
    nodes = set(trimesh.load(path).graph.nodes)
    for category in set(scene.label):
        assert sum(node.startswith(category) for node in nodes) == (scene.label == category).sum()


def test_outpaint_keeps_the_scene_and_its_seams_are_scored(smoke, samples, tmp_path):
    from jobs.evaluate_seams import Config as SeamsConfig
    from jobs.implementation.evaluate_seams import evaluate_seams
    from jobs.implementation.outpaint_scenes import outpaint
    from jobs.outpaint_scenes import Config as OutpaintConfig

    options = OutpaintConfig(
        model=str(smoke / "models/pritti-smoke"),
        input=str(samples),
        source="generated-samples",
        output=str(tmp_path),
        num_inference_steps=8,
        jump_length=2,
        num_resamplings=2,
    )
    outpaint(options)
    large, small = next(read_scenes(str(tmp_path))), next(read_scenes(str(samples), "generated-samples"))
    assert large.grid.rows == 2 * small.grid.rows and large.occupied.shape[1:] == (64, 64)
    middle = large.crop(small.grid)
    assert np.array_equal(middle.occupied, small.occupied) and len(middle) == len(small)
    assert np.allclose(middle.height_m, small.height_m, atol=0.006)
    assert (tmp_path / "glb/outpainted").is_dir()

    real = str(smoke / "datasets/smoke")
    seams_config = SeamsConfig(generated=str(tmp_path), real=real, output=str(tmp_path / "seams"), num_actors=1)
    seams = evaluate_seams(seams_config)
    count = seams["scenes"]["real"]
    assert seams["seams"] == {"generated": 4 * seams["scenes"]["generated"], "real": 3 * count, "joined": count}
    assert seams["ratios"]["height_step"]["joined"]["low"] > seams["ratios"]["height_step"]["real"]["high"]
    query = f"select metric, value from '{tmp_path}/seams/metrics.parquet'"
    assert dict(duckdb.sql(query).fetchall())["seams.generated"] == seams["seams"]["generated"] > 0
    assert (tmp_path / "seams/seams.html").read_text().count("<img") > 0


@pytest.mark.slow  # The test above scores the same seams for one setting.
def test_sweep_seams_compares_settings_with_ceiling_and_control(smoke, samples, tmp_path):
    from jobs.implementation.sweep_seams import sweep_seams
    from jobs.sweep_seams import Config as SweepConfig

    row, guided, *as_paper, ceiling, control = sweep_seams(
        SweepConfig(
            model=str(smoke / "models/pritti-smoke"),
            input=str(samples),
            source="generated-samples",
            settings=((4, 2, 2, 0.0, 1.0), (4, 1, 1, 1.0, 0.0)),
            neighbour_latents=("reencode", "paper"),
            real=str(smoke / "datasets/smoke"),
            output=str(tmp_path / "sweep"),
        )
    )
    assert [part["neighbour_latents"] for part in (row, guided, *as_paper)] == ["reencode"] * 2 + ["paper"] * 2
    assert row["seams"] == 4 and row["evaluations"] == 6 and "class_changes_high" in row
    assert guided["evaluations"] == 4 and guided["known_guidance"] == 1 and guided["objects_per_ha"] > 0
    assert control["height_step"] > ceiling["height_step_high"] and ceiling["seams"] == 3 * control["seams"]
    found = duckdb.sql(f"select evaluations from '{tmp_path}/sweep/sweep.parquet'").fetchall()
    assert found == [(6,), (4,)] * 2 + [(None,)] * 2
    assert (tmp_path / "sweep/sweep.html").read_text().count("<img") == 4


@pytest.mark.slow  # test_evaluate_job.py scores the ceiling and controls.
def test_evaluate_scores_generated_scenes_and_reconstruction(smoke, samples, tmp_path):
    from jobs.evaluate_scenes import Config
    from jobs.implementation.evaluate_scenes import evaluate

    scores = evaluate(
        Config(
            real=str(smoke / "datasets/smoke"),
            generated=str(samples),
            lvae=str(smoke / "models/lvae-smoke"),
            num_examples=0,
            guess_scenes=2,
            num_actors=1,
            output=str(tmp_path),
        )
    )
    made = scores["generation"]
    assert (tmp_path / "guess.html").read_text().count("<img") == 4
    assert made["scenes"] == {"real": 9, "generated": 9}
    assert made["layout_frechet"]["low"] < made["layout_frechet"]["value"] < made["layout_frechet"]["high"]
    sets = scores["reconstruction"]["sets"]
    assert scores["reconstruction"]["ground_iou"] < sets["ceiling"]["ground_iou"]
    assert sets["control"]["ap3d"] < 0.6 * sets["ceiling"]["ap3d"]
    written = duckdb.sql(
        f"select value, low, high from '{tmp_path}/metrics.parquet' where metric = 'generation.layout_frechet'"
    ).fetchall()
    assert written[0] == tuple(made["layout_frechet"].values())
    assert "fid" not in made and "precision_k3" not in made
    page = (tmp_path / "evaluation.html").read_text()
    assert page.count("<img") >= 2 * 9 and "95 % bootstrap" in page


def test_sample_loses_no_scene_after_actor_kill(smoke, samples, tmp_path):
    from models.labels import LABELS
    from pipelines.generation.sample import SampleRequest, sample_scenes

    model = str(smoke / "models/pritti-smoke")
    request = SampleRequest(model, str(tmp_path), "samples", 9, LABELS["vegetation"], 0, 10, 1.0, shard_scenes=1)
    killed = []

    def kill(row: dict) -> None:
        if not killed:
            killed.extend(kill_ray_workers("Sampler"))

    assert sample_scenes(request, num_actors=1, batch_size=1, on_shard=kill) == 9 and len(killed) == 1
    again, before = list(read_scenes(str(tmp_path))), list(read_scenes(str(samples)))
    assert [scene.scene_id for scene in again] == [scene.scene_id for scene in before]
    assert all(np.array_equal(a.occupied, b.occupied) for a, b in zip(again, before, strict=True))


def check_tiles(directory, whole: Scene) -> None:
    """Compare the tiles of a run with the whole scene, and each GLB file with its bounds in the tileset."""
    tiles = list(read_scenes(str(directory)))
    assert len(tiles) == 8 and sum(map(len, tiles)) == len(whole)
    placed = np.concatenate([tile.center_m + tile.world_xyz_m for tile in tiles])
    for first, second in ((placed, whole.center_m), (whole.center_m, placed)):
        assert cKDTree(first).query(second)[0].max() < 2e-3
    assert sum(int(tile.occupied.sum()) for tile in tiles) == whole.occupied.sum()
    (page,) = directory.glob("pages/street/*/index.html")
    names = [
        tile["name"] for tile in json.loads(page.read_text().split('id="data">')[1].split("</script>")[0])["tiles"]
    ]
    files = {file.stem for file in (page.parent / "tiles").iterdir()}
    assert files == {*names, *(f"{name}-far" for name in names)} and len(names) == 8
    (path,) = directory.rglob("tileset.json")
    tileset = json.loads(path.read_text())
    assert tileset["asset"]["version"] == "1.1" and len(tileset["root"]["children"]) == 8
    for child in tileset["root"]["children"]:
        mesh = trimesh.load(path.parent / child["content"]["uri"], force="mesh")  # y up
        points = np.stack([mesh.vertices[:, 0], -mesh.vertices[:, 2], mesh.vertices[:, 1]], axis=1)
        middle, half = (
            np.array(child["boundingVolume"]["box"][:3]),
            np.array(child["boundingVolume"]["box"])[[3, 7, 11]],
        )
        assert (np.abs(points - middle) <= half + 0.05).all()
        columns = np.array(child["transform"]).reshape(4, 4)
        world = points @ columns[:3, :3] + columns[3, :3]  # In the frame of the whole scene.
        box = np.array(tileset["root"]["boundingVolume"]["box"])
        assert (np.abs(world - box[:3]) <= box[[3, 7, 11]] + 0.05).all()


@pytest.mark.slow  # Sampling has the same tests with one block per scene.
def test_outpaint_is_independent_of_actors_and_actor_kill(smoke, samples, tmp_path):
    from models.sampling.repaint import RePaintConfig
    from pipelines.generation.outpaint import OutpaintRequest, outpaint_scenes
    from pipelines.schema.scene_subset import SceneSubset

    def request(name: str, **options) -> OutpaintRequest:
        repaint = RePaintConfig(num_inference_steps=4, jump_length=2, resamplings=2)
        model = str(smoke / "models/pritti-smoke")
        made = OutpaintRequest(model, str(tmp_path / name), "street", None, 0, 0.25, "reencode", repaint, 1.0)
        return replace(made, **{"num_blocks": (3, 0, 0, 1), "order": "colours", "batch_size": 2} | options)

    def run(name: str, tile_m: float | None = None, **options) -> pa.Table:
        tables = outpaint_scenes(request(name, tile_m=tile_m), chosen, **options)
        return pa.concat_tables(map(storage.read_parquet, tables))

    chosen = SceneSubset(str(samples), "generated-samples", None, 1, "first")
    table = run("whole")
    assert len(table) == 8 and set(table.column_names) >= {"ahead", "left", "datum_m", "known_ground"}
    (whole,) = read_scenes(str(tmp_path / "whole"))
    assert (whole.grid.rows, whole.grid.cols) == (32 + 3 * 24, 32 + 24)
    assert not list((tmp_path / "whole/blocks").rglob("*.safetensors"))
    killed, counts = [], []

    def kill(blocks: int) -> None:
        counts.append(blocks)
        if sum(counts) and not killed:
            killed.extend(kill_ray_workers("Outpainter"))

    assert run("killed", num_actors=3, on_blocks=kill).equals(table)
    assert killed and counts[0] == 0 and sum(counts) == 7

    class Stop(Exception):
        pass

    def stop(blocks: int) -> None:
        if blocks:
            raise Stop

    with pytest.raises(Stop):
        outpaint_scenes(request("resumed"), chosen, on_blocks=stop)
    left = []
    assert run("resumed", on_blocks=left.append).equals(table) and left[0] > 0
    for name in ("killed", "resumed"):
        (again,) = read_scenes(str(tmp_path / name))
        for part in ("category", "center_m", "size_m", "height_m", "occupied"):
            assert np.array_equal(getattr(again, part), getattr(whole, part)), (name, part)
    assert run("tiles", tile_m=64.0, num_actors=2).equals(table)
    check_tiles(tmp_path / "tiles", whole)
    lost = sorted((tmp_path / "tiles").rglob("scenes/*/*/part-00001.parquet"))
    lost[0].unlink()
    assert run("tiles", tile_m=64.0).equals(table)
    check_tiles(tmp_path / "tiles", whole)
    (path,) = outpaint_scenes(request("outward", order="outward", num_blocks=(1, 0, 0, 0)), chosen)
    (outward,) = storage.read_parquet(path).to_pylist()[1:]
    assert outward["ahead"] == 1


@pytest.mark.slow
def test_outpaint_follows_a_street_plan(smoke, tmp_path):
    from models.composition.road_sketch import RoadMap
    from models.pipeline import PrITTIPipeline
    from models.sampling.repaint import RePaintConfig
    from pipelines.generation.outpaint import OutpaintRequest, outpaint_scenes
    from pipelines.generation.sample import resample_to_model_grid
    from pipelines.schema.scene_subset import SceneSubset

    pipeline = PrITTIPipeline.from_pretrained(smoke / "models/pritti-smoke")
    pipeline.register_modules(street_planner=tiny_planner())
    pipeline.save_pretrained(tmp_path / "model")
    dataset = str(smoke / "datasets/smoke")
    chosen = SceneSubset(dataset, "town", "test", 1, "first")
    repaint = RePaintConfig(num_inference_steps=3, jump_length=1, resamplings=1)
    places = str(tmp_path / "model"), str(tmp_path / "out")
    request = OutpaintRequest(*places, "street", "low", 0, 0.25, "reencode", repaint, 1.0, (3, 0, 0, 1), "colours")

    class Stop(Exception):
        pass

    def stop(blocks: int) -> None:
        if blocks:
            raise Stop

    with pytest.raises(Stop):
        outpaint_scenes(request, chosen, on_blocks=stop)
    assert list((tmp_path / "out/blocks").rglob("streets*.safetensors"))
    outpaint_scenes(request, chosen, num_actors=2)
    (whole,) = read_scenes(str(tmp_path / "out"))
    given = resample_to_model_grid(next(iter(read_scenes(dataset, "town", "test"))), pipeline.spec)
    truth = pipeline.outpaint(
        given, "low", 0, 0, 0.25, "reencode", (3, 0, 0, 1), repaint, order="colours", free_blocks="none"
    )
    assert np.array_equal(whole.occupied, truth.occupied)
    classes = np.asarray(Image.open(tmp_path / "out/street_plans/street/generated-street-0-0000000.png")) // 127
    # Reach from the middle of the given scene: 2.75 blocks ahead, 1.25 blocks to the left.
    assert classes.shape == (2 * 176, 2 * 80) and set(np.unique(classes)) == {0, 1, 2}
    drawn, _ = RoadMap.from_classes((classes == 2).astype(np.uint8), 1.0, (32.0, 0.0)).draw(given.grid)
    road = given.occupied[given.ground_classes.index("road")]
    assert road.any() and (drawn & road).sum() > 0.8 * road.sum()
    with pytest.raises(ValueError, match="with plan_streets=true"):
        outpaint_scenes(replace(request, plan_streets=False), chosen)


def test_inpaint_writes_variants_and_resumes(smoke, samples, tmp_path):
    from jobs.implementation.inpaint_scenes import inpaint
    from jobs.inpaint_scenes import Config

    config = Config(
        model=str(smoke / "models/pritti-smoke"),
        input=str(samples),
        source="generated-samples",
        half_plane=(1.0, 0.0, 32.0),
        contents="objects",
        num_variants=2,
        max_scenes=2,
        output=str(tmp_path),
        num_inference_steps=8,
        jump_length=2,
        num_resamplings=2,
    )
    drift = inpaint(config)
    assert 0 <= drift["ground_iou"] <= 1 and 0 <= drift["objects_found"] <= 1
    given, made = list(read_scenes(str(samples), limit=2)), list(read_scenes(str(tmp_path)))
    assert len({scene.scene_id for scene in made}) == 4 == len(list((tmp_path / "glb/inpainted").iterdir()))
    for k, scene in enumerate(made):
        assert np.array_equal(scene.occupied, given[k // 2].occupied)
        behind = [sorted(s.center_m[s.center_m[:, 0] < 32].tolist()) for s in (scene, given[k // 2])]
        assert behind[0] == behind[1]
    assert (tmp_path / "inpainted.html").read_text().count("<img") == 6
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.parquet")}
    assert inpaint(config) == drift and times == {path: path.stat().st_mtime_ns for path in times}
    with pytest.raises(ValueError, match="holds a run 'inpainted' with seed=0, asked for 1"):
        inpaint(replace(config, seed=1))
    with pytest.raises(ValueError, match="the region contains no pixel"):
        inpaint(replace(config, half_plane=(1.0, 0.0, 99.0), run="other"))
    Path(find_shards(str(samples))[0].path("scenes")).touch()  # the file may have different scenes after this change
    with pytest.raises(ValueError, match="holds a run 'inpainted' with other scenes; choose another --run"):
        inpaint(config)


def test_furnish_keeps_the_map_and_resumes(smoke, tmp_path):
    from jobs.furnish_place import Config
    from jobs.implementation.furnish_place import main
    from pipelines.schema.attribution import ATTRIBUTIONS

    config = Config(
        model=str(smoke / "models/pritti-smoke"),
        input=make_town_street().write(tmp_path / "map.osm"),
        origin=(LATITUDE, LONGITUDE, LATITUDE, LONGITUDE + 0.001),
        size_m=96.0,
        label="low",
        output=str(tmp_path / "out"),
    )
    main(config)
    given, made = list(read_scenes(str(tmp_path / "out/maps/furnished"))), list(read_scenes(config.output))
    assert len(given) == len(made) == 2
    assert all(len(list((tmp_path / f"out/{kind}/furnished").iterdir())) == 2 for kind in ("glb", "pictures"))
    big = CATEGORY_INDEX["construction_big"]
    for before, after in zip(given, made, strict=True):
        houses = [sorted(scene.center_m[scene.category == big].tolist()) for scene in (before, after)]
        assert len(houses[0]) > 4 and houses[0] == houses[1]
        road = [scene.occupied[scene.ground_classes.index("road")] for scene in (before, after)]
        assert np.array_equal(*road) and road[0].any()
        assert after.attribution == ATTRIBUTIONS["osm"] and after.source == "generated-furnished"
    (glb,) = [path for path in (tmp_path / "out/glb/furnished").iterdir() if "0000000-0" in path.name]
    assert "OpenStreetMap" in json.dumps(trimesh.load(glb).metadata) or b"OpenStreetMap" in glb.read_bytes()
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.parquet")}
    main(config)
    assert times == {path: path.stat().st_mtime_ns for path in times}
    with pytest.raises(ValueError, match="holds a run 'furnished' with"):
        main(replace(config, heading_deg=45.0))
    with pytest.raises(ValueError, match="--size-m is 97, expected at least 64"):
        main(replace(config, size_m=97.0))


def test_run_guard_keeps_noise_scaling_of_guided_run(smoke, tmp_path):
    from models.sampling.repaint import RePaintConfig
    from pipelines.generation.outpaint import OutpaintRequest
    from pipelines.generation.sample import guard_generation_run, load_pipeline

    model = str(smoke / "models/pritti-smoke")
    pipeline = load_pipeline(model)
    for run, repaint in (("paper", RePaintConfig()), ("guided", RePaintConfig.guided())):
        request = OutpaintRequest(model, str(tmp_path), run, None, 0, 0.5, "reencode", repaint, 1.0)
        pipeline.register_to_config(noise_scaling=1.0)
        guard_generation_run(request, pipeline, [str(smoke)])
        pipeline.register_to_config(noise_scaling=1.01)
        if run == "paper":  # RePaint ignores noise_scaling
            guard_generation_run(request, pipeline, [str(smoke)])
    with pytest.raises(ValueError, match=r"holds a run 'guided' with noise_scaling=1.0, asked for 1.01"):
        guard_generation_run(request, pipeline, [str(smoke)])


def test_run_guard_keeps_how_pag_treats_labels(smoke, tmp_path):
    from pipelines.generation.sample import SampleRequest, guard_generation_run, load_pipeline

    model = str(smoke / "models/pritti-smoke")
    pipeline = load_pipeline(model)
    for run, pag_scale in (("plain", 0.0), ("pag", 2.0)):
        request = SampleRequest(model, str(tmp_path), run, 1, ("low",), 0, 5, 1.0, pag_scale=pag_scale)
        for drops in (False, True):
            pipeline.register_to_config(pag_drops_label=drops)
            if drops and pag_scale:
                with pytest.raises(ValueError, match="holds a run 'pag' with pag_drops_label"):
                    guard_generation_run(request, pipeline, [str(smoke)])
            else:
                guard_generation_run(request, pipeline, [str(smoke)])


def test_evaluate_real_against_itself_is_near_perfect(smoke, tmp_path):
    """The evaluator compares training scenes with the same scenes, so the scores show its noise floor."""
    from pipelines.evaluation.evaluate import compare_datasets
    from pipelines.evaluation.features import FeatureConfig, compute_scene_features
    from pipelines.schema.dataset import Dataset
    from pipelines.schema.scene_subset import SceneSubset

    dataset = Dataset.open(str(smoke / "datasets/smoke"))
    side = compute_scene_features(
        SceneSubset(dataset.root, "town", "train"), dataset, FeatureConfig(), str(tmp_path / "described")
    ).read()
    scores = compare_datasets(side, side, dataset.spec.ground_classes)
    assert abs(scores["layout_frechet"].value) < 1e-4 and abs(scores["random_frechet"].value) < 1e-4
    assert scores["random_precision_k3"].value == scores["random_recall_k3"].value == 1.0
    assert scores["random_coverage_k3"].value == 1.0
    assert scores["label_fidelity"]["joint_fidelity"].value == 1.0
    assert all(found["between"].value == 0 for found in scores["distance"].values())


def test_scene_features_resume_interrupted_run(smoke, tmp_path, monkeypatch):
    """The second call keeps existing parts and computes missing parts. If the options change, the call recomputes all
    parts."""
    from pipelines.evaluation import features as module
    from pipelines.schema.dataset import Dataset
    from pipelines.schema.scene_subset import SceneSubset

    dataset = Dataset.open(str(smoke / "datasets/smoke"))
    chosen, config, directory = (
        SceneSubset(dataset.root, "town", "train"),
        module.FeatureConfig(),
        tmp_path / "described",
    )
    first = module.compute_scene_features(chosen, dataset, config, str(directory)).read()
    parts = sorted(directory.glob("part-*.parquet"))
    assert len(parts) == len(chosen.shards()) > 1
    kept, times = parts[1:], [part.stat().st_mtime_ns for part in parts[1:]]
    parts[0].unlink()
    again = module.compute_scene_features(chosen, dataset, config, str(directory)).read()
    assert [part.stat().st_mtime_ns for part in kept] == times
    assert all(
        np.array_equal(first[name], again[name], equal_nan=name in ("statistics", "relations")) for name in first
    )
    module.compute_scene_features(chosen, dataset, module.FeatureConfig(supersample=2), str(directory))
    assert all(part.stat().st_mtime_ns > time for part, time in zip(kept, times, strict=True))
