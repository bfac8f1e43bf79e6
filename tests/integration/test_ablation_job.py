"""Tests of the ablation jobs on Ray: tables, figures, resuming and trained variants."""

import json
import xml.etree.ElementTree as ElementTree
from dataclasses import asdict
from pathlib import Path

import duckdb
import pytest
import torch

from models.presets import LVAE_PRESETS
from models.vae.config import LayoutVAEConfig, override_options
from pipelines.evaluation.ablation import (
    AUGMENTATION_VARIANTS,
    BRANCH_VARIANTS,
    DECODER_VARIANTS,
    DETR_VARIANTS,
    select_measures,
)


@pytest.fixture(scope="module")
def empty_home(cluster, tmp_path_factory):
    """An empty $PRITTI_HOME. The encoding study needs no data, and the smoke preset creates its dataset."""
    with pytest.MonkeyPatch.context() as patch:
        path = tmp_path_factory.mktemp("ablation")
        patch.setenv("PRITTI_HOME", str(path))
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        yield path


def test_encoding_study_writes_table_and_figure_and_resumes(empty_home, capsys):
    from jobs.ablate_lvae import Encoding
    from jobs.implementation.ablate_lvae import compare_encodings

    config = Encoding(
        (64, 128),
        any_footprint_train_sizes=(64,),
        yaw_only_train_sizes=(32,),
        num_seeds=1,
        epochs=1,
        num_test_boxes=300,
        num_noisy_boxes=20,
    )
    output = empty_home / "ablations/encoding"
    assert compare_encodings(config) == str(output)
    assert "mean IoU3D" in capsys.readouterr().out and "octahedral" in (output / "encodings.txt").read_text()
    rows = duckdb.sql(f"select * from '{output}/encodings.parquet' where numbers = 'all'").fetchall()
    assert len(rows) == 9 and len(json.loads((output / "encodings.json").read_text())["rows"]) == 12
    lost = duckdb.sql(f"select count(*), count(distinct noise) from '{output}/yaw_loss.parquet'").fetchall()
    assert lost == [(120, 4)]
    for name in ("encodings", "yaw_loss"):
        assert ElementTree.parse(output / f"{name}.svg").getroot().tag == "{http://www.w3.org/2000/svg}svg"
    page = (output / "report.html").read_text()
    assert page.count("<svg") == 4 and "[drawings" not in page and page.count("<table") == 3

    kept = {path: path.stat().st_mtime_ns for path in sorted((output / "trials").iterdir())}
    redone = next(iter(kept))
    before = json.loads(redone.read_text())
    redone.unlink()
    compare_encodings(config)
    assert [p for p, time in kept.items() if p.stat().st_mtime_ns != time] == [redone]
    assert json.loads(redone.read_text())["iou"] == before["iou"]
    with pytest.raises(ValueError, match="holds a study with epochs=1, asked for 2"):
        compare_encodings(Encoding(train_sizes=(64,), num_seeds=1, epochs=2, num_test_boxes=300))


@pytest.mark.slow  # Builds every variant of the study.
def test_variant_differs_from_preset_only_in_its_switch(empty_home):
    from jobs.ablate_lvae import Augmentation, Branches, Decoders, Detr
    from jobs.implementation.ablate_lvae import prepare_variant
    from jobs.support.trainer import convert_to_tensors
    from pipelines.training.data_loader import read_samples

    for config, variant, switch in (
        *((Branches(preset="smoke"), *item) for item in BRANCH_VARIANTS.items()),
        *((Decoders(preset="smoke"), *item) for item in DECODER_VARIANTS.items()),
        *((Augmentation(preset="smoke"), *item) for item in AUGMENTATION_VARIANTS.items()),
        *((Detr(preset="smoke"), *item) for item in DETR_VARIANTS.items()),
    ):
        run = prepare_variant(config, variant, f"test-{variant}", seed=1, steps=3)
        trainer = run.build(torch.device("cpu"), lambda model: model)
        row = LVAE_PRESETS["smoke"]
        assert trainer.settings.steps == 3 and trainer.settings.seed == 1 == run.stream.seed
        assert trainer.settings.learning_rate == switch.options.get("learning_rate", row.learning_rate)
        mirrored = run.reader.augment is not None and run.reader.augment.flip
        assert mirrored == switch.options.get("flip", False)
        assert run.stream.batch_size == row.batch_size
        wanted = LayoutVAEConfig(**override_options(row.architecture(), switch.architecture))
        assert {name: trainer.model.config[name] for name in asdict(wanted)} == asdict(wanted)
        batch = convert_to_tensors(read_samples(run.stream, run.reader, 0, 1, row.batch_size, 0, 1))
        assert torch.isfinite(trainer.step(batch, range(row.batch_size))["loss"])


def test_compare_variants_trains_each_seed_once(empty_home, town_dataset, monkeypatch, capsys):
    import jobs.implementation.ablate_lvae as job

    trained = []

    def train_variant(config, variant, seed, output):
        trained.append((seed, variant))
        scores = {"ground_iou": 0.9 + 0.01 * seed, "height_mse_normalised": 1e-4, "height_rmse_m": 0.1}
        described = {"variant": variant, "seed": seed, "steps": config.steps, "dataset": town_dataset, "parameters": 1}
        held_out = job.select_held_out(config, town_dataset).fingerprint()
        described |= {"gflops": 0.5, "held_out_scenes": held_out}
        scores |= {"ap3d": 0.5, "ap3d_50": 0.25, "recall_1m": 0.6}
        scores |= {"median_center_error_m": 0.4, "other_latent_center_error_m": 5.0}
        described |= {"training_seconds": 1.0, "curve": [(2, 0.1), (7, 0.5)]}
        return described | select_measures(BRANCH_VARIANTS[variant], scores)

    monkeypatch.setattr(job, "train_variant", train_variant)
    output = job.compare_variants(job.Branches(preset="smoke", steps=7, num_seeds=2))
    assert trained == [(seed, variant) for seed in (0, 1) for variant in BRANCH_VARIANTS]
    job.compare_variants(job.Branches(preset="smoke", steps=7, num_seeds=3))
    assert trained[8:] == [(2, variant) for variant in BRANCH_VARIANTS]
    job.compare_variants(job.Branches(preset="smoke", steps=7, num_seeds=4, only_variants=("without ground",)))
    assert trained[12:] == [(3, "without ground")]
    job.compare_variants(job.Branches(preset="smoke", steps=7, num_seeds=3))
    rows = {row["variant"]: row for row in json.loads((Path(output) / "branches.json").read_text())["rows"]}
    full, bare = rows["full model"], rows["without ground"]
    assert (full["seeds"], full["steps"]) == (3, 7) and abs(full["ground_iou_mean"] - 0.91) < 1e-9
    assert (full["ground_iou_min"], full["ground_iou_max"]) == (0.9, 0.92) and bare["ap3d_mean"] == 0.5
    assert bare["ground_iou_mean"] is None and rows["without objects"]["ap3d_mean"] is None
    assert rows["without ground"]["other_latent_center_error_m_mean"] == 5.0
    printed = capsys.readouterr().out
    assert "without" in printed and "split" in printed and "0.40 (5.00)" in printed
    sets = job.score_held_out(job.Branches(preset="smoke"), town_dataset, output)
    assert sets["ceiling"]["ap3d"] > 2 * sets["control"]["ap3d"] > 0
    assert all(f"{100 * scores['ap3d']:.3g}" in printed for scores in sets.values())
    with pytest.raises(ValueError, match="holds a study with steps=7, asked for 8"):
        job.compare_variants(job.Branches(preset="smoke", steps=8, num_seeds=2))
    record = Path(output) / "runs/full-model-seed0.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"held_out_scenes": "others"}))
    with pytest.raises(ValueError, match=f"the held-out scenes of {town_dataset} have changed since 'full model'"):
        job.compare_variants(job.Branches(preset="smoke", steps=7, num_seeds=2))
    with pytest.raises(ValueError, match=r"--only-variants \['without sky'\]: expected some of \['full model'"):
        job.compare_variants(job.Branches(preset="smoke", steps=7, only_variants=("without sky",)))
    with pytest.raises(ValueError, match="--max-scenes is 1, expected 2 or more"):
        job.compare_variants(job.Branches(preset="smoke", max_scenes=1, name="another"))
    with pytest.raises(ValueError, match="unknown preset 'smokes'"):
        job.compare_variants(job.Branches(preset="smokes", name="another"))
    assert not (Path(output).parent / "another").exists()
