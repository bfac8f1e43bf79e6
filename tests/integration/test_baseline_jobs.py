"""Tests of the jobs that voxelise scenes, and that train and run voxel methods, on Ray."""

import json
from pathlib import Path

import numpy as np
import pytest
import ray
import torch
from helpers import fit_here
from PIL import Image

from jobs.support.cli import find_root_cause
from models.baselines.directory import load_baseline
from models.voxel_grids import COARSE_FACTORS, coarsen_voxels
from pipelines.generation.voxel_sample import iterate_voxels
from pipelines.geometry.voxels import VoxelGrid, voxelize
from pipelines.io.voxel_import import draw_voxels
from pipelines.io.voxel_table import read_grid, unpack_voxels
from pipelines.runtime import storage
from pipelines.schema.tables import Shard, find_shards

METHOD = "semcity"


@pytest.fixture(scope="module")
def voxels(cluster, town_dataset) -> str:
    """The town dataset with the table voxels."""
    from jobs.implementation.voxelize_scenes import main
    from jobs.voxelize_scenes import Config

    main(Config(input=town_dataset))
    return town_dataset


@pytest.fixture(scope="module")
def model(voxels, tmp_path_factory) -> str:
    """A model of the smoke preset, which this process trains without Ray Train."""
    import jobs.support.trainer
    from jobs.implementation.train_baseline import train
    from jobs.train_baseline import Config

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(jobs.support.trainer, "fit", fit_here)
        monkeypatch.setenv("PRITTI_HOME", str(tmp_path_factory.mktemp("baselines")))
        return train(Config(METHOD, preset="smoke", dataset=voxels))


def test_voxelize_scenes_writes_grids_of_all_scenes(voxels):
    shards = find_shards(voxels, "voxels")
    assert [shard.number for shard in shards] == [0, 0, 1] and len({shard.split for shard in shards}) == 2
    for shard in shards:
        table, scenes = shard.read("voxels"), shard.scenes()
        assert table["scene_id"].to_pylist() == [scene.scene_id for scene in scenes]
        for k, scene in enumerate(scenes):
            fine = unpack_voxels(table, k)
            assert np.array_equal(fine, voxelize(scene, VoxelGrid(scene.grid)))
            assert read_grid(table, k) == VoxelGrid(scene.grid)
            for factor in COARSE_FACTORS:
                assert np.array_equal(unpack_voxels(table, k, factor), coarsen_voxels(fine, factor))


def test_voxelize_scenes_resumes_and_refuses_other_options(voxels, town_dataset, capsys):
    from jobs.implementation.voxelize_scenes import main
    from jobs.voxelize_scenes import Config

    first, last = (Path(shard.path("voxels")) for shard in find_shards(voxels, "voxels")[::2])
    content, stamp = first.read_bytes(), last.stat().st_mtime_ns
    first.write_bytes(content[:1000])
    main(Config(input=town_dataset))
    assert first.read_bytes() == content and last.stat().st_mtime_ns == stamp
    assert "voxels of 12 scenes" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"holds voxels with top_m=6.5, asked for 14.5; choose another --output"):
        main(Config(input=town_dataset, voxel_range_m=(-1.5, 14.5)))
    with pytest.raises(ValueError, match=r"--coarse-voxels 3x3x3: expected some of 1x1x2, 2x2x2"):
        main(Config(input=town_dataset, coarse_voxels=("3x3x3",)))


def test_train_baseline_equals_training_in_one_process(voxels, model, monkeypatch, tmp_path):
    """Ray Train gives the same weights up to rounding. Other options of the same run are refused."""
    from jobs.implementation.train_baseline import train
    from jobs.train_baseline import Config

    pipeline = load_baseline(model)
    assert pipeline.method == METHOD and sorted(pipeline.networks) == ["autoencoder", "diffusion"]
    monkeypatch.setenv("PRITTI_HOME", str(tmp_path))
    options = {"preset": "smoke", "dataset": voxels, "stage": "autoencoder"}
    place = train(Config(METHOD, **options))
    trained = type(pipeline.networks["autoencoder"]).from_pretrained(f"{place}/autoencoder").state_dict()
    # Instance normalisation removes the effect of most other parameters, whose gradients are rounding errors.
    for name in ("before.0.weight", "after.0.weight", "logits.weight"):
        assert torch.allclose(trained[name], pipeline.networks["autoencoder"].state_dict()[name], atol=1e-4), name
    with pytest.raises(ValueError, match="was started with learning_rate="):
        train(Config(METHOD, learning_rate=0.5, **options))


def test_train_baseline_needs_voxels_stages_and_memory(town_dataset, voxels, model, tmp_path, monkeypatch):
    import jobs.implementation.train_baseline as job
    from jobs.train_baseline import Config

    monkeypatch.setenv("PRITTI_HOME", str(tmp_path))
    options = {"preset": "smoke", "dataset": voxels}
    with pytest.raises(ValueError, match=r"no trained stage autoencoder of semcity .*--stage autoencoder first"):
        job.train(Config(METHOD, stage="diffusion", **options))
    with pytest.raises(ValueError, match="semcity has no stage 'level1', expected one of: autoencoder, diffusion"):
        job.train(Config(METHOD, stage="level1", **options))
    with pytest.raises(ValueError, match="semcity has no preset 'large', expected one of: smoke, town, paper"):
        job.train(Config(METHOD, preset="large", dataset=voxels))
    bare = tmp_path / "bare"
    for name in ("scenes", "dataset.json"):
        (bare / name).parent.mkdir(exist_ok=True)
        (bare / name).symlink_to(Path(town_dataset) / name)
    with pytest.raises(ValueError, match=r"bare/voxels holds no scenes.*; run jobs/voxelize_scenes.py --input"):
        job.train(Config(METHOD, preset="smoke", dataset=str(bare)))
    stage = job.find_stage(METHOD, "smoke", "autoencoder")
    made = job.make_baseline_trainer(stage, stage.architecture, {}, [1] * 18, stage.optimizer, torch.device("cpu"))
    first = {"voxels_8x8x8": torch.ones(1, 32, 32, 4, dtype=torch.uint8)}
    sample = job.measure_sample_bytes(made, first)
    fixed = job.STEP_COPIES * 4 * made.model.num_parameters()
    monkeypatch.setattr(job, "find_available_bytes", lambda: fixed + 2.5 * sample)
    job.require_memory(made, first, 2, "semcity")
    with pytest.raises(ValueError, match=r"semcity: 8 samples need .* GB are free .*steps 4 or a smaller --batch-size"):
        job.require_memory(made, first, 8, "semcity")
    monkeypatch.setattr(job, "find_available_bytes", lambda: fixed + 0.5 * sample)
    with pytest.raises(ValueError, match="use a smaller --preset or a machine with more memory"):
        job.require_memory(made, first, 1, "semcity")


def test_model_of_another_method_is_refused(model, tmp_path):
    from jobs.implementation.sample_baseline import sample
    from jobs.sample_baseline import Config

    other = tmp_path / "other"
    other.mkdir()
    (other / "baseline.json").write_text(Path(model, "baseline.json").read_text().replace("semcity", "lidargen"))
    with pytest.raises(ValueError, match=r"method is 'lidargen', expected one of: semcity, pdd, xcube"):
        sample(Config(str(other), output=str(tmp_path)))
    (other / "baseline.json").write_text(Path(model, "baseline.json").read_text())
    (other / "autoencoder").symlink_to(Path(model, "diffusion"))
    with pytest.raises(ValueError, match=r"no trained stage autoencoder of semcity .*TriplaneUNet"):
        sample(Config(str(other), output=str(tmp_path)))
    with pytest.raises(ValueError, match=r"no voxel method here .*pass a directory of jobs/train_baseline.py"):
        sample(Config(str(tmp_path), output=str(tmp_path)))


@pytest.mark.parametrize("task", ["sample", "reconstruct", "inpaint", "outpaint"])
def test_sample_baseline_writes_voxels_and_pictures(task, voxels, model, tmp_path):
    from jobs.implementation.sample_baseline import sample
    from jobs.sample_baseline import Config

    given = {} if task == "sample" else {"input": voxels}
    config = Config(model, task, output=str(tmp_path), num_scenes=3, batch_size=2, half="left", **given)
    _, summary = sample(config)
    shards = find_shards(str(tmp_path), "voxels", source=f"generated-semcity-{task}")
    made = dict(iterate_voxels(shards))
    side = 512 if task == "outpaint" else 256
    assert len(made) == 3 and {grid.shape for grid in made.values()} == {(side, side, 32)}
    assert summary["seconds_per_scene"] > 0 and summary["peak_bytes"] > 1e7
    recorded = json.loads((tmp_path / f"generated-semcity-{task}-voxels.json").read_text())
    assert recorded == summary and recorded["method"] == "semcity"
    with np.load(tmp_path / f"semcity-{task}.npz") as pictures:
        assert np.array_equal(pictures["arr_0"], np.stack([draw_voxels(grid) for grid in made.values()]))
    assert Image.open(tmp_path / f"semcity-{task}.png").size[0] > side
    if task == "sample":
        assert list(made) == [f"semcity-sample-{k:06d}" for k in range(3)]
        again, _ = sample(Config(model, task, output=str(tmp_path / "b"), num_scenes=2, batch_size=1))
        for name, grid in iterate_voxels(again.shards()):
            assert np.array_equal(grid, made[name])
        return
    truth = dict(iterate_voxels(find_shards(voxels, "voxels", split="test")))
    assert list(made) == list(truth)[:3]
    if task == "outpaint":
        grid = read_grid(shards[0].read("voxels"), 0).columns
        assert (grid.front_m, grid.left_m) == (96.0, 64.0)
    for name, grid in made.items():
        coarse = coarsen_voxels(truth[name], (8, 8, 8)).repeat(8, 0).repeat(8, 1).repeat(8, 2)
        if task == "inpaint":
            assert np.array_equal(grid[:, 128:], coarse[:, 128:])
        if task == "outpaint":
            assert np.array_equal(grid[128:384, 128:384], coarse)
    with pytest.raises(ValueError, match=r"holds a run .* with seed=0, asked for 1; choose another --run"):
        sample(Config(model, task, output=str(tmp_path), num_scenes=3, half="left", seed=1, **given))
    with pytest.raises(ValueError, match="4 scenes of split test have voxels, expected at least 9"):
        sample(Config(model, task, output=str(tmp_path / "c"), num_scenes=9, **given))


def test_voxels_of_another_size_are_refused(voxels, model, tmp_path, monkeypatch):
    """The bytes of the second scene do not have the stated size."""
    from jobs.implementation.sample_baseline import sample
    from jobs.sample_baseline import Config

    shard = Shard(str(tmp_path), "town", "test", 0)
    table = find_shards(voxels, "voxels", split="test")[0].read("voxels")
    rows = table.to_pylist()
    rows[1]["rows"] = 128
    storage.write_parquet(type(table).from_pylist(rows, schema=table.schema), shard.path("voxels"))
    # As in Ray that a job starts.
    monkeypatch.setattr(ray.data.DataContext.get_current(), "raise_original_map_exception", True)
    with pytest.raises(Exception, match="voxels") as caught:
        sample(Config(model, "reconstruct", input=str(tmp_path), output=str(tmp_path / "out"), num_scenes=2))
    cause = find_root_cause(caught.value)
    assert type(cause) is ValueError and str(cause).startswith(f"{shard.path('voxels')}: row 1, column 'voxels': ")
