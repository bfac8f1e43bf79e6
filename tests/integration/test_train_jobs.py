"""Tests of the training jobs on Ray with the smoke presets: job order, resuming, two workers and invalid input."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import duckdb
import numpy as np
import pyarrow as pa
import pytest
import torch
from helpers import fit_here, run_command, small_spec
from safetensors.torch import load_file

from models.dit import DiT
from models.presets import LVAE_PRESETS
from models.tensors import make_layout_batch
from models.training import OptimizerConfig, make_dit_trainer
from pipelines.preprocess.street_maps import compute_map_thresholds
from pipelines.schema.dataset import Dataset
from pipelines.schema.mixture import Mixture
from pipelines.schema.tables import find_shards
from pipelines.training.data_loader import LatentReader
from pipelines.training.latents import digest_weights, load_lvae
from pipelines.training.street_map_reader import StreetMapReader


def load_weights(directory: Path) -> dict:
    return load_file(directory / "diffusion_pytorch_model.safetensors")


def test_train_dit_creates_inputs_of_smoke_preset(home):
    assert (home / "datasets/smoke/dataset.json").exists()
    rows = duckdb.sql(
        "select split, count(*), count(distinct vegetation_density) "
        f"from '{home}/datasets/smoke/scenes/**/*.parquet' group by 1"
    ).fetchall()
    assert {split: count for split, count, _ in rows} == {"train": 32, "test": 16}
    latents = json.loads((home / "datasets/smoke/latents.json").read_text())
    assert latents["complete"] and latents["scenes"] == {"train": 32, "test": 16}
    assert (home / "models/pritti-smoke/model_index.json").exists()
    assert not list(home.rglob("*.pkl")) and not list(home.rglob("*.pt"))


def test_train_dit_conditions_on_a_label_that_the_data_have(home):
    from jobs.implementation.checks import resolve_label_kind
    from jobs.implementation.train_dit import check_training_labels
    from jobs.train_dit import Config

    town = Dataset.open(str(home / "datasets/smoke"))
    kept = [k for k, name in enumerate(town.spec.categories) if not name.startswith("vegetation")]
    fields = {name: tuple(getattr(town.spec, name)[k] for k in kept) for name in ("categories", "slots")}
    plants_missing = Mixture((town, replace(town, root="/other", spec=replace(town.spec, **fields))), (1.0, 1.0))
    assert resolve_label_kind(Config(), replace(plants_missing, weights=(1.0, 0.0))) == "vegetation"
    assert resolve_label_kind(Config(), Mixture((town,), (1.0,))) == "vegetation"
    assert resolve_label_kind(Config(), plants_missing) == "vehicle"  # the paper's condition for Argoverse 2
    assert resolve_label_kind(Config(label_kind="none"), plants_missing) == "none"
    for kind in ("vegetation", "joint"):
        with pytest.raises(ValueError, match=rf"--label-kind {kind}: .*no objects of the group vegetation.*vehicle or"):
            resolve_label_kind(Config(label_kind=kind), plants_missing)

    class Uniform:
        def read(self, table, columns):
            return pa.table({column: ["medium"] * 3 for column in columns})

    with pytest.raises(ValueError, match="all 3 training scenes have the label 'medium'"):
        check_training_labels([Uniform()], "vegetation")


def test_encode_latents_match_lvae_and_scene_order(home):
    from models.tensors import make_layout_batch
    from pipelines.training.latents import load_lvae

    shard = find_shards(str(home / "datasets/smoke"), split="test")[0]
    table, scenes = shard.read("latents"), shard.scenes()
    assert table["scene_id"].to_pylist() == [s.scene_id for s in scenes]
    lvae = load_lvae(str(home / "models/lvae-smoke"))
    want = lvae.encode(make_layout_batch(scenes, lvae.spec)).mean.numpy()
    got = table["mean"].combine_chunks().to_numpy_ndarray()
    assert got.dtype == np.float16 and np.allclose(got, want, atol=2e-3 * np.abs(want).max())


def test_encode_writes_the_latents_of_streets(home, tmp_path):
    from jobs.encode_latents import Config
    from jobs.implementation.encode_latents import encode
    from models.composition.road_sketch import keep_streets
    from models.tensors import make_layout_batch
    from pipelines.training.data_loader import LatentReader
    from pipelines.training.latents import load_lvae

    root, lvae = str(home / "datasets/smoke"), str(home / "models/lvae-smoke")
    found = encode(Config(dataset=root, lvae=lvae, output=str(tmp_path), streets=True))
    assert found["complete"] and found["streets"]
    shard = find_shards(root, split="test")[0]
    arrays = LatentReader({shard.root: str(tmp_path)}, "vegetation", streets=True)(shard, np.arange(2))
    kept = [keep_streets(scene) for scene in shard.scenes([0, 1])]
    model = load_lvae(lvae)
    want = model.encode(make_layout_batch([scene for scene, _ in kept], model.spec)).mean.numpy()
    got = arrays["street_ground"]
    assert np.allclose(got, want[:, : len(want[0]) // 2], atol=2e-3 * np.abs(want).max())
    size = got.shape[-1]
    for cells, (scene, paved) in zip(arrays["street_cells"], kept, strict=True):
        side = scene.grid.rows // size
        assert np.array_equal(cells, paved.reshape(size, side, size, side).all(axis=(1, 3)))


def test_street_planner_joins_a_pipeline(home, tmp_path, monkeypatch):
    import jobs.support.trainer
    from jobs.implementation.train_street_planner import train
    from jobs.train_street_planner import Config
    from models.labels import LABELS
    from models.pipeline import PrITTIPipeline

    monkeypatch.setattr(jobs.support.trainer, "fit", fit_here)
    model = str(home / "models/pritti-smoke")
    config = Config("smoke", model=model, dataset=str(tmp_path / "maps"), output=str(tmp_path / "made"), num_maps=3)
    assert train(config) == config.output
    pipeline = PrITTIPipeline.from_pretrained(config.output)
    assert pipeline.plans_streets and pipeline.street_planner.config.size == 64
    assert digest_weights(pipeline.dit) == digest_weights(PrITTIPipeline.from_pretrained(model).dit)
    shards = find_shards(config.dataset, "street_maps")
    assert [(shard.split, shard.read("street_maps").num_rows) for shard in shards] == [("test", 4), ("train", 3)]
    reader = StreetMapReader(tuple(compute_map_thresholds(shards[1:]).items()), seed=0)
    arrays = reader(shards[1], np.arange(3), np.arange(3))
    assert arrays["mean"].shape == (3, 2, 64, 64) and all(
        LABELS["partial"][k].endswith("-free") for k in arrays["label"].tolist()
    )
    # The distances of maps are normalised.
    plain = replace(reader, seed=None)(shards[1], np.arange(3))["mean"].astype(float)
    assert np.allclose(plain.mean((0, 2, 3)), pipeline.street_planner.config.shift)
    with pytest.raises(ValueError, match="this pipeline has no street planner; omit the option"):
        train(replace(config, name="again", start_from=model))
    with pytest.raises(ValueError, match="--num-maps is 0, expected at least 1"):
        train(replace(config, name="again", num_maps=0))


def test_train_logs_run_and_model_to_mlflow(home):
    from jobs.support.tracking import make_client

    api = make_client(f"sqlite:///{home}/mlflow.db")
    for experiment in ("pritti-lvae", "pritti-dit"):
        run = api.search_runs([api.get_experiment_by_name(experiment).experiment_id])[0]
        assert run.info.status == "FINISHED" and run.data.params["preset"] == "smoke"
        assert {"loss", "learning_rate", "scenes_per_second", "validation_loss"} <= set(run.data.metrics)
        assert len(api.get_metric_history(run.info.run_id, "loss")) == 8
        artifacts = {a.path for a in api.list_artifacts(run.info.run_id)}
        assert "model" in artifacts and artifacts & {"reconstruction", "samples"}


def test_train_lvae_leaves_finished_run_unchanged(home):
    from jobs.implementation.train_lvae import train
    from jobs.train_lvae import Config

    before = load_weights(home / "models/lvae-smoke")
    train(Config(preset="smoke"))
    after = load_weights(home / "models/lvae-smoke")
    assert all((before[k] == after[k]).all() for k in before)
    with pytest.raises(ValueError, match=r"run 'lvae-smoke' was started with learning_rate=0.001, asked for 0.5"):
        train(Config(preset="smoke", learning_rate=0.5))


@pytest.mark.slow  # tests/faults/test_faults.py kills workers of other stages.
def test_train_lvae_resumes_after_worker_kills(home, tmp_path, monkeypatch, capsys):
    """A worker dies twice. Ray Train may replace it once; the second round begins because there is a checkpoint."""
    import jobs.support.trainer
    from jobs.implementation.train_lvae import prepare
    from jobs.support.trainer import fit
    from jobs.train_lvae import Config

    monkeypatch.setattr(jobs.support.trainer, "RETRIES", 1)
    seen = tmp_path / "validated"
    run = prepare(Config(preset="smoke", name="lvae-killed", checkpoint_every=3))
    first = run.reader

    class DieTwice:
        def __call__(self, trainer):
            with seen.open("a") as file:
                print(trainer.steps_done, file=file)
            if trainer.steps_done >= 6 and seen.read_text().count("6") < 3:
                os.kill(os.getpid(), 9)
            return {}, {}

    output = fit(replace(run, validate=DieTwice(), reader=first), 1, str(home / "models/lvae-killed"))
    # The worker dies at step 6. Training resumes at step 3.
    assert seen.read_text().split() == ["3", "6", "6", "6", "8"]
    assert (
        "lvae-killed: workers failed 2 times, but there is a new checkpoint; training continues"
        in capsys.readouterr().out
    )
    whole, resumed = load_weights(home / "models/lvae-smoke"), load_weights(Path(output))
    assert all((whole[k] == resumed[k]).all() for k in whole)


@pytest.mark.slow  # test_train_lvae_with_two_workers_matches_one uses the same trainer.
def test_train_dit_with_three_workers_matches_one_and_resumes(home, tmp_path, monkeypatch):
    import jobs.support.trainer
    from jobs.implementation.train_dit import prepare, train
    from jobs.support.trainer import fit
    from jobs.train_dit import Config

    seen = tmp_path / "validated"

    def record_step(trainer):
        with seen.open("a") as file:
            print(trainer.steps_done, file=file)
        return {}, {}

    def stop_at_four(trainer):
        if trainer.steps_done == 4:
            raise KeyError("stopped")
        return {}, {}

    monkeypatch.setattr(jobs.support.trainer, "RETRIES", 0)
    run, _ = prepare(Config(preset="smoke", name="dit-three", num_workers=3, checkpoint_every=2))
    assert run.stream.batch_size == 8
    with pytest.raises(Exception, match="stopped"):
        fit(replace(run, validate=stop_at_four), 3, str(home / "models/three"))  # shares of 2, 3 and 3 samples
    fit(replace(run, validate=record_step), 3, str(home / "models/three"))
    assert seen.read_text().split() == [
        "4",
        "6",
        "8",
    ]  # training resumes at step 2, and the hook runs at steps 4, 6 and 8
    one, three = load_weights(home / "models/pritti-smoke/dit"), load_weights(home / "models/three")
    for name in one:
        assert np.allclose(one[name], three[name], atol=1e-4), name
    assert not list((home / "runs").rglob("*.pkl"))
    with pytest.raises(ValueError, match=r"--num-workers 4\) needs 0.5 CPU 4 times, .* has room for 3: 1 node"):
        train(Config(preset="smoke", name="dit-four", num_workers=4))
    with pytest.raises(ValueError, match="--batch-size 1 is smaller than --num-workers 2"):
        train(Config(preset="smoke", name="dit-odd", num_workers=2, batch_size=1))


@pytest.mark.parametrize("ema_decay", [None, 0.9])
def test_rounding_of_result_does_not_change_training(ema_decay):
    from jobs.support.trainer import make_result

    settings = OptimizerConfig(8, 1e-3, 0.0, ema_decay=ema_decay)
    trainer = make_dit_trainer(DiT(channels=4, size=8, width=32, depth=1, heads=2), settings, 0.1, torch.device("cpu"))
    before = {name: value.clone() for name, value in trainer.model.state_dict().items()}
    result = make_result(trainer, None, round_weights=True).state_dict()
    assert all(torch.equal(value, before[name]) for name, value in trainer.model.state_dict().items())
    assert all(torch.equal(value, before[name].half().float()) for name, value in result.items())
    assert not all(torch.equal(value, before[name]) for name, value in result.items())
    plain = make_result(trainer, None, round_weights=False).state_dict()
    assert all(torch.equal(value, before[name]) for name, value in plain.items())


def test_result_is_the_mean_with_other_weights():
    from jobs.support.trainer import make_result

    sizes = {"channels": 4, "size": 8, "width": 32, "depth": 1, "heads": 2}
    trainer = make_dit_trainer(
        DiT(inpainting=True, **sizes), OptimizerConfig(8, 1e-3, 0.0, ema_decay=None), 0.1, torch.device("cpu")
    )
    other = DiT(**sizes).state_dict()
    trained = {name: value.clone() for name, value in trainer.model.state_dict().items()}
    result = make_result(trainer, other, round_weights=False).state_dict()
    assert set(result) - set(other) == {"known_in.weight"}
    for name, value in result.items():
        wanted = (trained[name] + other[name]) / 2 if name in other else trained[name]
        assert torch.allclose(value, wanted, atol=1e-7), name
    assert all(torch.equal(value, trained[name]) for name, value in trainer.model.state_dict().items())


def test_train_lvae_with_two_workers_matches_one(home):
    from jobs.implementation.train_lvae import train
    from jobs.train_lvae import Config

    output = train(Config(preset="smoke", name="lvae-two", num_workers=2, round_weights=True))
    one, two = load_weights(home / "models/lvae-smoke"), load_weights(Path(output))
    assert [{str(value.dtype) for value in part.values()} for part in (one, two)] == [
        {"torch.float32"},
        {"torch.float16"},
    ]
    distance = max(np.abs(one[name] - two[name]).max() for name in one)
    assert distance < 1e-2, distance


@pytest.mark.slow
def test_train_lvae_retrains_object_decoder_for_kept_latents(home):
    from jobs.implementation.train_lvae import train
    from jobs.train_lvae import Config

    kept, output = home / "models/pritti-smoke", home / "models/pritti-decoder"
    assert train(Config(preset="smoke", name="decoder", train_object_decoder_of=str(kept))) == str(output)
    old, new = load_weights(kept / "lvae"), load_weights(output / "lvae")
    changed = {name for name in old if (old[name] != new[name]).any()}
    assert len(changed) > 20 and all(name.startswith("object_decoder.") for name in changed)
    assert all(
        (value == load_weights(output / "dit")[name]).all() for name, value in load_weights(kept / "dit").items()
    )
    with pytest.raises(ValueError, match=r"--name smoke: .*/pritti-smoke holds a pipeline that would be replaced"):
        train(Config(preset="smoke", name="smoke", train_object_decoder_of=str(kept)))
    with pytest.raises(
        ValueError, match="its latent_channels is 4, but that of this preset is 16; use the preset of this pipeline"
    ):
        train(
            Config(
                preset="demo",
                name="other",
                dataset=str(home / "datasets/smoke"),
                train_object_decoder_of=str(kept),
            )
        )


def test_train_lvae_starts_from_trained_weights(home):
    from jobs.implementation.checks import check_train_lvae
    from jobs.implementation.train_lvae import load_start, prepare
    from jobs.train_lvae import Config

    trained = load_weights(home / "models/pritti-smoke/lvae")
    for number, model in enumerate((home / "models/pritti-smoke", home / "models/pritti-smoke/lvae")):
        run = prepare(Config(preset="smoke", name=f"more-{number}", start_from=str(model)))
        built = run.build(torch.device("cpu"), lambda model: model).model.state_dict()
        assert all(torch.equal(built[name], value) for name, value in trained.items())
        assert run.identity["start_from"]
    dataset = str(home / "datasets/smoke")
    with pytest.raises(ValueError, match=r"--start-from /nowhere: no PrITTI pipeline here, .* no layout VAE"):
        check_train_lvae(Config(preset="smoke", start_from="/nowhere"))
    with pytest.raises(ValueError, match=r"--start-from .*its latent_channels is 4, but that of this preset is 16"):
        prepare(Config(preset="demo", name="other", dataset=dataset, start_from=str(model)))
    with pytest.raises(ValueError, match="--round-weights would change the encoders"):
        check_train_lvae(Config(preset="smoke", round_weights=True, train_object_decoder_of="town"))
    with pytest.raises(ValueError, match="exclude each other"):
        prepare(Config(preset="smoke", name="both", start_from=str(model), train_object_decoder_of=str(model)))
    found = load_start(str(model), LVAE_PRESETS["smoke"].architecture(), small_spec())
    assert found.spec == Dataset.open(dataset).spec.with_resolution(32)


def test_encode_rejects_lvae_of_another_dataset(home, tmp_path):
    from jobs.encode_latents import Config
    from jobs.implementation.encode_latents import encode

    shutil.copytree(home / "datasets/smoke", tmp_path, dirs_exist_ok=True)
    about = json.loads((tmp_path / "dataset.json").read_text())
    about["layout"]["ground_classes"].append("crossing")
    (tmp_path / "dataset.json").write_text(json.dumps(about))
    shutil.rmtree(tmp_path / "latents")
    with pytest.raises(ValueError, match=r"has the ground_classes crossing, which the layout of the model lacks"):
        encode(Config(dataset=str(tmp_path), lvae=str(home / "models/lvae-smoke")))
    assert not (tmp_path / "latents").exists()


def test_train_lvae_names_truncated_shard(home, tmp_path):
    from jobs.implementation.train_lvae import train
    from jobs.train_lvae import Config

    shutil.copytree(home / "datasets/smoke", tmp_path / "data")
    for shard in find_shards(str(tmp_path / "data"), split="train"):
        path = Path(shard.path("rasters"))
        path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(ValueError, match=r"rasters/.*parquet: cannot be read as Parquet"):
        train(Config(preset="smoke", dataset=str(tmp_path / "data"), name="lvae-truncated"))


@pytest.mark.slow
def test_encode_reports_worker_error_in_one_line(home, tmp_path):
    """If an actor reads a truncated shard, the job exits with code 2 and prints no traceback."""
    shutil.copytree(home / "datasets/smoke", tmp_path / "data")
    (tmp_path / "data/latents.json").unlink()
    path = Path(find_shards(str(tmp_path / "data"))[-1].path("rasters"))
    path.write_bytes(path.read_bytes()[:-50])
    words = (
        "--dataset",
        str(tmp_path / "data"),
        "--lvae",
        str(home / "models/lvae-smoke"),
        "--output",
        str(tmp_path / "out"),
    )
    done = run_command("jobs/encode_latents.py", *words)
    lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert done.returncode == 2 and len(lines) == 1, done.stderr[-2000:]
    assert path.name in lines[0] and "delete it and run the job that wrote it again" in lines[0]


def test_models_train_on_two_datasets(home, tmp_path, capsys, monkeypatch):
    """Both stages mix a town and a dataset of another surface, with one layout and the labels of the first."""
    from jobs.encode_latents import Config as EncodeConfig
    from jobs.implementation.checks import check_train_dit
    from jobs.implementation.encode_latents import encode
    from jobs.implementation.train_dit import prepare as prepare_dit
    from jobs.implementation.train_dit import train as train_dit
    from jobs.implementation.train_lvae import prepare, train
    from jobs.train_dit import Config as DiTConfig
    from jobs.train_lvae import Config

    monkeypatch.setattr("jobs.support.trainer.fit", fit_here)
    town, maps = str(home / "datasets/smoke"), str(tmp_path / "maps")
    for shard in find_shards(town):
        scenes = [
            replace(
                scene,
                source="osm",
                scene_id=f"osm-{scene.scene_id}",
                height_m=scene.height_m - 0.3 * scene.occupied,
                vegetation_density="low",
                vehicle_density="low",
            )
            for scene in shard.scenes()
        ]
        replace(shard, root=maps, source="osm").write(scenes)
    about = json.loads(Path(town, "dataset.json").read_text()) | {"source": "osm"}
    bounds = about["layout"]["height_bounds_m"]
    low, high = bounds["low"][0] - 0.4, bounds["high"][0] + 0.1
    about["layout"] |= {"surface": "surface", "height_bounds_m": {"low": [low], "high": [high]}}
    about["vegetation_thresholds"] = dict.fromkeys(about["vegetation_thresholds"], 1e6)
    Path(maps, "dataset.json").write_text(json.dumps(about))

    mixed = {"add_datasets": (maps,), "dataset_weights": (2.0, 1.0), "dataset": town, "preset": "smoke"}
    lvae = train(Config(**mixed, name="lvae-mixed"))
    layout = json.loads(Path(lvae, "config.json").read_text())["layout"]
    assert layout["height_bounds_m"]["low"] == pytest.approx([low + 0.3])
    assert layout["height_bounds_m"]["high"] == pytest.approx([high + 0.3]) and layout["surface"] == "top"
    start = prepare(Config(**mixed, name="lvae-more", start_from=str(home / "models/lvae-smoke")))
    assert "has ground heights from" in capsys.readouterr().out
    assert start.identity["dataset_weights"] == [2.0, 1.0] and start.identity["added_sources"] == "osm"
    built = start.build(torch.device("cpu"), lambda model: model).model
    assert built.spec == Dataset.open(town).spec.with_resolution(32)

    latents = [str(tmp_path / name) for name in ("town-latents", "map-latents")]
    for root, output in zip((town, maps), latents, strict=True):
        encode(EncodeConfig(dataset=root, lvae=lvae, output=output))
    options = mixed | {"latents": latents[0], "add_latents": (latents[1],), "label_kind": "joint"}
    with pytest.raises(ValueError, match=r"map.*no latents\.json here"):
        check_train_dit(DiTConfig(**{**options, "add_latents": ()}))
    with pytest.raises(ValueError, match=r"map-latents holds latents of .*maps, expected those of .*smoke; give"):
        check_train_dit(DiTConfig(**{**options, "latents": latents[1], "add_latents": (latents[0],)}))
    with pytest.raises(ValueError, match=r"latents of another layout VAE.*--add-latents"):
        check_train_dit(DiTConfig(**{**options, "latents": ""}))
    run, _ = prepare_dit(DiTConfig(**options, name="dit-prepared"))
    assert {shard.source for shard in run.stream.shards} == {"town", "osm"}
    shard = next(shard for shard in run.stream.shards if shard.source == "osm")
    arrays = run.reader(shard, np.arange(4))
    same = LatentReader({town: latents[0]}, "joint")(replace(shard, root=town, source="town"), np.arange(4))
    # The scenes are those of the town on another surface, so their latents and labels are equal.
    model = load_lvae(lvae)
    with torch.no_grad():
        unconverted = model.encode(make_layout_batch(shard.scenes(list(range(4))), model.spec)).mean.numpy()
    errors = [np.abs(found.astype(float) - same["mean"]).max() for found in (arrays["mean"], unconverted)]
    assert errors[0] < 0.2 * errors[1]
    assert arrays["label"].tolist() == same["label"].tolist() and len(set(same["label"])) > 1
    output = train_dit(DiTConfig(**options, name="dit-mixed"))
    assert Path(output, "model_index.json").exists()
