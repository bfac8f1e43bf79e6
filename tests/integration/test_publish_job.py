"""Tests of jobs/publish_model.py: the records that it requires, and the names of published models."""

import json
from pathlib import Path

import pytest
from helpers import tiny_planner

from models.pretrained import CHECKSUMS_NAME, compute_checksums


@pytest.fixture(scope="module")
def evaluation_directory(smoke) -> Path:
    """Folder of an evaluation with scores of scenes and reconstructions of the smoke model."""
    from jobs import evaluate_scenes, sample_scenes
    from jobs.implementation.evaluate_scenes import evaluate
    from jobs.implementation.sample_scenes import sample

    sample(
        sample_scenes.Config(
            num_scenes=6,
            run="judged",
            sampler="dpm++",
            num_inference_steps=2,
            noise_scaling=1.01,
            existence_threshold=0.25,
        )
    )
    real, lvae = str(smoke / "datasets/smoke"), str(smoke / "models/lvae-smoke")
    config = evaluate_scenes.Config(
        real=real, real_split="test", run="judged", lvae=lvae, max_reconstructed_scenes=4, num_examples=0, num_actors=1
    )  # fmt: skip
    evaluate(config)
    return smoke / "evaluations/judged"


def test_publish_writes_model_with_card_and_finds_it(smoke, evaluation_directory):
    from jobs.implementation.publish_model import publish
    from jobs.publish_model import Config
    from jobs.support.model_directories import find_pipeline_directory
    from pipelines.generation.sample import load_pipeline

    output, reference, run_id = publish(Config(name="tiny", evaluation=str(evaluation_directory)))
    entry = Path(output)
    assert reference == "models:/tiny/1" and entry == smoke / "zoo/tiny"
    assert json.loads((entry / CHECKSUMS_NAME).read_text()) == compute_checksums(entry)
    card, scores = (entry / "README.md").read_text(), json.loads((evaluation_directory / "metrics.json").read_text())
    assert f"| {scores['generation']['random_frechet']['value']:.4g} (" in card
    assert "| training steps | 8 |" in card and "learning_rate 0.001" in card and "options" in card
    for path in entry.rglob("*"):  # no file contains a path of this machine
        assert path.is_dir() or b"/tmp/" not in path.read_bytes()
    for picture in ("samples.png", "failures.png"):
        assert (entry / picture).read_bytes()[:4] == b"\x89PNG"
    pipeline = load_pipeline(output)  # the pipeline has the settings of the evaluated scenes
    assert pipeline.config.noise_scaling == 1.01 and pipeline.config.existence_threshold == 0.25
    trained = {name: value.tolist() for name, value in pipeline.dit.state_dict().items()}
    for name in ("tiny", reference, run_id):
        again = load_pipeline(find_pipeline_directory(name)).dit.state_dict()
        assert {name: value.tolist() for name, value in again.items()} == trained
    kept = smoke / "registry" / run_id
    assert (
        json.loads((kept / CHECKSUMS_NAME).read_text()) == compute_checksums(kept)
        and len(list(kept.parent.iterdir())) == 1
    )
    second = publish(Config(name="tiny", evaluation=str(evaluation_directory)))
    assert second[1] == "models:/tiny/2"
    (damaged,) = smoke.glob(f"mlartifacts/**/{second[2]}/**/dit/config.json")
    damaged.write_text(damaged.read_text() + " ")
    with pytest.raises(ValueError, match=r"models:/tiny/2: its files do not match its checksums.json"):
        find_pipeline_directory(second[1])
    assert not (kept.parent / second[2]).exists()
    assert publish(Config(name="tiny", evaluation=str(evaluation_directory), register=False)) == [output]


def test_publish_rejects_model_without_own_evaluation(smoke, evaluation_directory, tmp_path):
    from jobs.implementation.publish_model import publish
    from jobs.publish_model import Config

    with pytest.raises(ValueError, match=r"no evaluation here; run jobs/sample_scenes.py"):
        publish(Config(name="none", evaluation=str(tmp_path)))
    about, scores = (
        json.loads((evaluation_directory / f"{name}.json").read_text()) for name in ("evaluation", "metrics")
    )
    other = about | {"sampling": about["sampling"] | {"weights": "aa-bb"}}
    elsewhere = tmp_path / "town"
    elsewhere.mkdir()
    (elsewhere / "dataset.json").write_text((Path(about["real"]) / "dataset.json").read_text())
    inpainted = about | {"sampling": {"weights": about["sampling"]["weights"]}}
    repaired = about | {"sampling": about["sampling"] | {"repair": True}}
    for spoilt, less, message in (
        (repaired, {}, "evaluates repaired scenes; evaluate scenes that were sampled without --repair"),
        (other, {}, r"belongs to other weights \(aa-bb\)"),
        (about | {"sampling": None}, {}, "belongs to other weights"),
        (inpainted, {}, "does not evaluate scenes of jobs/sample_scenes.py"),
        (
            about | {"real": str(elsewhere)},
            {},
            r"uses the real scenes of .*/town, but the Layout VAE was trained on .*; run .* --real",
        ),
        (about, {"reconstruction"}, "contains no reconstruction scores"),
    ):
        (tmp_path / "evaluation.json").write_text(json.dumps(spoilt))
        (tmp_path / "metrics.json").write_text(json.dumps({k: v for k, v in scores.items() if k not in less}))
        with pytest.raises(ValueError, match=message):
            publish(Config(name="none", evaluation=str(tmp_path)))
    assert not (smoke / "zoo/none").exists()


def test_publish_rejects_weights_without_provenance(smoke, evaluation_directory, monkeypatch, tmp_path):
    from jobs.implementation.publish_model import publish
    from jobs.publish_model import Config

    first = Path(
        publish(Config(evaluation=str(evaluation_directory), output=str(tmp_path / "first"), register=False))[0]
    )
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/other.db")
    monkeypatch.setattr("jobs.implementation.publish_model.home_path", lambda *parts: str(tmp_path.joinpath(*parts)))
    config = Config(
        model=str(smoke / "models/pritti-smoke"),
        evaluation=str(evaluation_directory),
        output=str(tmp_path / "second"),
        register=False,
    )  # fmt: skip
    with pytest.raises(ValueError, match="trained these weights"):
        publish(config)
    (tmp_path / "zoo").mkdir()
    first.rename(tmp_path / "zoo/first")  # publish() reads training.json of this folder because MLflow has no run
    records = tmp_path / "zoo/first/training.json"
    trainings = json.loads(records.read_text())
    for change, accepted in (({"num_train": 5000}, True), ({"seed": 1}, False)):
        records.write_text(json.dumps([run | {"data": run["data"] | change} for run in trainings]))
        if accepted:
            publish(config)
            assert "| training scenes | 5,000 |" in (tmp_path / "second/README.md").read_text()
        else:
            with pytest.raises(ValueError, match=r"the Layout VAE was trained on .*'seed': 1"):
                publish(config)
    records.write_text(json.dumps(trainings))
    publish(config)
    cards = [tmp_path / place / "README.md" for place in ("zoo/first", "second")]
    assert cards[0].read_text() == cards[1].read_text()


def test_train_dit_starts_from_weights_and_records_both_runs(smoke, tmp_path):
    import torch

    from jobs.implementation.publish_model import read_history
    from jobs.implementation.train_dit import prepare
    from jobs.support.trainer import convert_to_tensors, tag_weights
    from jobs.train_dit import Config
    from pipelines.generation.sample import load_pipeline
    from pipelines.training.data_loader import iterate_batches
    from pipelines.training.latents import digest_weights

    start, more = str(tmp_path / "start"), tmp_path / "more"
    pipeline = load_pipeline(str(smoke / "models/pritti-smoke"))
    pipeline.register_to_config(noise_scaling=1.01, existence_threshold=0.25)
    pipeline.street_planner = tiny_planner()
    pipeline.save_pretrained(start)
    options = {"final_learning_rate": 1e-5, "warmup_steps": 1, "steps": 2}
    run, complete = prepare(Config(preset="smoke", name="more", start_from=start, **options))
    trainer = run.build(torch.device("cpu"), lambda model: model)
    first = load_pipeline(start).dit
    assert digest_weights(trainer.model) == digest_weights(first) == run.identity["start_from"]
    assert [run.settings.at(step)[0] for step in (0, 1)] == [pytest.approx(1e-3), pytest.approx(1e-5)]
    for batch in iterate_batches(run.stream, run.reader, 0, run.settings.steps):
        trainer.step(convert_to_tensors(batch), range(run.stream.batch_size))
    tag_weights(run.tracker, trainer.ema_model(), trainer.steps_done)
    history = read_history("pritti-dit", "Transformer", trainer.ema_model())
    assert [(run.name, run.stage, run.steps) for run in history] == [
        ("dit", "Transformer", 8),
        ("dit-2", "Transformer, run 2", 2),
    ]
    assert history[1].options["start_from"] == history[0].weights == digest_weights(first)
    first.save_pretrained(more / "dit")
    result = load_pipeline(complete(str(more)))
    # The settings and the street planner are those of the initial pipeline.
    assert result.config["noise_scaling"] == 1.01 and result.config["existence_threshold"] == 0.25
    assert result.plans_streets
    with pytest.raises(ValueError, match=r"its label is vegetation, but that of this run is vehicle"):
        prepare(Config(preset="smoke", name="other", start_from=start, label_kind="vehicle"))
    with pytest.raises(ValueError, match=r"--start-from town: .* another layout VAE"):
        prepare(Config(preset="smoke", name="other", start_from="town"))
    with pytest.raises(ValueError, match=r"--average-with town: .* another layout VAE"):
        prepare(Config(preset="smoke", name="other", average_with="town"))
    averaged = prepare(Config(preset="smoke", name="mean", start_from=start, average_with=start))[0]
    assert averaged.identity["average_with"] == averaged.identity["start_from"]


def test_pipeline_directory_rejects_unknown_model(smoke, tmp_path):
    from jobs.support.model_directories import find_pipeline_directory

    for name in ("nobody", "models:/nobody/1", "0" * 32, str(tmp_path)):
        with pytest.raises(ValueError, match=r"no PrITTI pipeline|no published pipeline"):
            find_pipeline_directory(name)
