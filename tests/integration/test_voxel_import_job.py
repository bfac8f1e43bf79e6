"""Tests of the jobs that import and score meshes and voxels, on Ray."""

import json
from dataclasses import replace
from pathlib import Path

import duckdb
import numpy as np
import pytest
from helpers import save_npz

from pipelines.geometry.voxels import VoxelGrid, voxelize
from pipelines.io.mesh_export import export_glb
from pipelines.io.voxel_import import FULL, draw_voxels, export_voxels_npz, write_voxels
from pipelines.metrics.reconstruction import compute_voxel_confusion
from pipelines.preprocess.import_external import ImportRequest, find_files, read_files
from pipelines.schema.palette import CLASS_ID
from pipelines.schema.tables import Shard, find_shards, read_scenes


@pytest.fixture(scope="module")
def town_scenes(town_drive_3) -> list:
    return [town_drive_3.scene(k, "test") for k in np.linspace(0, len(town_drive_3) - 1, 6).astype(int)]


# ------------------------------------------------------------------------------------------------ jobs/import_scenes


def test_import_meshes_writes_tables_of_same_scenes(cluster, tmp_path, town_scenes):
    from jobs.implementation.import_scenes import import_scenes
    from jobs.import_scenes import Config

    meshes, output = tmp_path / "meshes", tmp_path / "out"
    for k, scene in enumerate(town_scenes):
        path = meshes / ("day" if k % 2 else "night") / f"{k}.glb"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(export_glb(scene))
    good = (meshes / "night/4.glb").read_bytes()
    (meshes / "night/4.glb").write_bytes(good[:1000])
    config = Config((str(meshes),), name="theirs", output=str(output))
    found, made = import_scenes(config)
    assert found == str(output) and made["rejects"] == 1
    order = ["day-1", "day-3", "day-5", "night-0", "night-2"]
    assert made["scenes"] == order
    got = list(read_scenes(str(output), "imported-theirs", "generated"))
    assert [scene.scene_id for scene in got] == order and {scene.sequence for scene in got} == {"theirs"}
    for scene, k in zip(got, (1, 3, 5, 0, 2), strict=True):
        want = town_scenes[k]
        assert np.array_equal(scene.category, want.category) and np.array_equal(scene.center_m, want.center_m)
        assert (
            np.abs(scene.surface()[0] - want.surface()[0]).max() <= 0.005 + 1e-6
        )  # tables store heights in steps of 1 cm
        assert np.array_equal(scene.surface()[1], want.surface()[1])
    ((reject,),) = (duckdb.sql(f"select reason from '{output}/rejects/**/*.parquet'").fetchall(),)
    assert "night/4.glb" in reject[0] and "expected a whole file" in reject[0]

    kept = Path(find_shards(str(output))[0].path("scenes"))
    stamp = kept.stat().st_mtime_ns
    (meshes / "night/4.glb").write_bytes(good)  # after this repair, the same command reads only this file
    assert import_scenes(config)[1]["rejects"] == 0
    assert len(list(read_scenes(str(output)))) == 6 and not list((output / "rejects").rglob("*.parquet"))
    assert kept.stat().st_mtime_ns == stamp
    whole = kept.read_bytes()
    kept.write_bytes(whole[:-50])  # The same command writes a damaged shard again.
    import_scenes(config)
    assert kept.read_bytes() == whole
    (meshes / "night/6.glb").write_bytes(good)
    with pytest.raises(ValueError, match=r"holds an import 'theirs' with other files; choose another"):
        import_scenes(config)


def test_import_scenes_reads_all_files_of_the_authors(cluster, real_data, tmp_path):
    """A shell expands DIR/*.glb into many arguments; the files are Open3D's, with `data:` URIs."""
    from jobs.implementation.import_scenes import import_scenes
    from jobs.import_scenes import Config

    files = sorted((real_data / "glb").glob("*.glb"))
    output, made = import_scenes(Config(tuple(map(str, files)), output=str(tmp_path)))
    assert len(files) == 4 and made["scenes"] == [file.stem for file in files] and made["rejects"] == 0
    same = import_scenes(Config((str(real_data / "glb" / "*.glb"),), output=str(tmp_path)))  # the quoted pattern
    assert same == (output, made)


def test_find_files_combines_arguments(tmp_path):
    for name in ("a/1.glb", "a/2.glb", "b/c/3.glb", "b/4.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    a, b = str(tmp_path / "a"), str(tmp_path / "b")
    assert (
        find_files((f"{a}/1.glb", f"{a}/2.glb"), ".glb") == find_files(f"{a}/*.glb", ".glb") == (a, ("1.glb", "2.glb"))
    )
    assert find_files((f"{b}/", f"{a}/1.glb", f"{a}/1.glb"), ".glb") == (str(tmp_path), ("a/1.glb", "b/c/3.glb"))
    with pytest.raises(ValueError, match=r"5\.glb matches no \.glb file"):
        find_files((f"{a}/1.glb", f"{a}/5.glb"), ".glb")


@pytest.mark.slow  # Other tests import scenes and evaluate scenes.
def test_evaluate_scores_imported_scenes(smoke, tmp_path):
    from jobs.evaluate_scenes import Config as EvaluateConfig
    from jobs.implementation.evaluate_scenes import evaluate
    from jobs.implementation.import_scenes import import_scenes
    from jobs.import_scenes import Config

    scenes = list(read_scenes(str(smoke / "datasets/smoke"), split="test"))
    for scene in scenes:
        (tmp_path / f"{scene.scene_id}.glb").write_bytes(export_glb(scene))
    output, _ = import_scenes(Config((str(tmp_path / "*.glb"),), output=str(tmp_path / "out")))
    real = str(smoke / "datasets/smoke")
    scores = evaluate(
        EvaluateConfig(real, "test", output, balance_labels=False, output=str(tmp_path / "scores"), num_actors=1)
    )
    generation = scores["generation"]
    assert generation["scenes"] == {"real": len(scenes), "generated": len(scenes)}
    assert generation["random_frechet"]["value"] < 1e-4  # both sides have identical images
    assert all(found["between"]["value"] < 1e-9 for found in generation["count_distance"].values())


def test_import_voxels_writes_pictures(cluster, tmp_path, town_scenes):
    from jobs.implementation.import_scenes import import_scenes
    from jobs.import_scenes import Config

    for k, scene in enumerate(town_scenes[:3]):
        write_voxels(str(tmp_path / "in" / f"scene{k}.npz"), scene)
    save_npz(tmp_path / "in" / "scene1b.npz", np.zeros((4, 4, 4), np.uint8))
    config = Config((str(tmp_path / "in"),), name="peer", format="npz", output=str(tmp_path / "out"))
    target, made = import_scenes(config)
    assert made["scenes"] == ["scene0", "scene1", "scene2"] and made["rejects"] == 1
    want = np.stack([draw_voxels(voxelize(scene, VoxelGrid())) for scene in town_scenes[:3]])
    with np.load(target) as pictures:
        assert pictures.files == ["arr_0"] and pictures["arr_0"].dtype == np.uint8
        assert np.array_equal(pictures["arr_0"], want)
    reasons = duckdb.sql(f"select scene_id, reason from '{tmp_path}/out/rejects/**/*.parquet'").fetchall()
    assert len(reasons) == 1 and reasons[0][0] == "scene1b" and "4 x 4 x 4" in reasons[0][1]

    write_voxels(str(tmp_path / "in" / "scene1b.npz"), town_scenes[3])
    target, made = import_scenes(config)
    assert made["scenes"] == ["scene0", "scene1", "scene1b", "scene2"] and made["rejects"] == 0
    assert len(np.load(target)["arr_0"]) == 4 and not list((tmp_path / "out").rglob(".pictures*"))
    assert import_scenes(config) == (target, made)
    assert json.loads((tmp_path / "out/imported-peer.json").read_text()) == made


def damage_meshes(folder: Path, good: bytes) -> dict[str, str]:
    """Write GLB files that are damaged in different ways, and return words of the expected reasons by scene id."""
    size = int.from_bytes(good[12:16], "little")
    faults = {
        "empty": (b"", "the file is empty"),
        "cut": (good[:1000], "expected a whole file"),
        "nan": (good.replace(b'"matrix":[', b'"matrix":[NaN,', 1), "expected a whole file"),
        "json": (good[:20] + b"{" * size + good[20 + size :], "the JSON chunk is invalid"),
        "text": (b"solid cube", "not a binary glTF file"),
        "far": (good.replace(b'"existence":1.0', b'"existence":9.0', 1), "'existence' is 9.0"),
    }
    for name, (content, _) in faults.items():
        assert content != good
        (folder / f"{name}.glb").write_bytes(content)
    return {name: words for name, (_, words) in faults.items()}


def damage_voxels(folder: Path, good: bytes) -> dict[str, str]:
    """Write .npz files that are damaged in different ways, and return words of the expected reasons by scene id."""
    encrypted, payload = bytearray(good), bytearray(good)
    encrypted[good.index(b"PK\1\2") + 8] |= 1
    payload[80:120] = bytes(40)
    faults = {
        "empty": (b"", "not an .npz archive"),
        "cut": (good[:-100], "not an .npz archive"),
        "encrypted": (bytes(encrypted), "is encrypted"),
        "payload": (bytes(payload), "is damaged"),
    }
    for name, (content, _) in faults.items():
        (folder / f"{name}.npz").write_bytes(content)
    return {name: words for name, (_, words) in faults.items()}


@pytest.mark.parametrize("kind", ["glb", "npz"])
def test_import_rejects_each_bad_file_and_reads_the_others(cluster, tmp_path, town_scenes, kind):
    from jobs.implementation.import_scenes import import_scenes
    from jobs.import_scenes import Config

    for k, scene in enumerate(town_scenes[:2]):
        good = export_glb(scene) if kind == "glb" else export_voxels_npz(scene)
        (tmp_path / "in").mkdir(exist_ok=True)
        (tmp_path / f"in/scene{k}.{kind}").write_bytes(good)
    expected = {"glb": damage_meshes, "npz": damage_voxels}[kind](tmp_path / "in", good)
    _, made = import_scenes(Config((str(tmp_path / "in"),), format=kind, output=str(tmp_path / "out")))
    assert made["scenes"] == ["scene0", "scene1"] and made["rejects"] == len(expected)
    rows = duckdb.sql(f"select scene_id, reason from '{tmp_path}/out/rejects/**/*.parquet'").fetchall()
    assert {name for name, _ in rows} == expected.keys()
    for name, reason in rows:
        assert f"in/{name}.{kind}: " in reason and expected[name] in reason, reason


@pytest.mark.parametrize("error", [MemoryError("large"), IndexError("5"), OSError("gone"), RecursionError("deep")])
def test_import_continues_after_an_unexpected_error(tmp_path, error):
    """An error in a reader also becomes a reject."""
    files = tuple(f"{k:02d}.glb" for k in range(16))  # Two files per shard.
    request = ImportRequest("in", files, "glb", ("x+", "y-", "z-"), str(tmp_path), "x")

    def read(index: int, name: str, uri: str) -> str:
        if name == "00":
            raise error
        return name

    assert read_files(request, request.shards()[0], read) == (["01"], ["01"])
    rows = duckdb.sql(f"select scene_id, reason from '{tmp_path}/rejects/**/*.parquet'").fetchall()
    assert rows == [("00", f"in/00.glb: {type(error).__name__}: {error}")]


def test_import_rejects_input_without_scenes(cluster, tmp_path):
    from jobs.implementation.import_scenes import import_scenes
    from jobs.import_scenes import Config

    (tmp_path / "a.glb").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"none of the 1 files could be read; error of the first file: .*a\.glb"):
        import_scenes(Config((str(tmp_path),), output=str(tmp_path / "out")))
    with pytest.raises(ValueError, match=r"matches no \.npz file"):
        import_scenes(Config((str(tmp_path),), format="npz"))
    with pytest.raises(ValueError, match=r"--name is 'a/b'"):
        import_scenes(Config((str(tmp_path),), name="a/b"))
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/b.glb").write_bytes(b"x")
    (tmp_path / "sub-b.glb").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"two files give the same scene id 'sub-b'"):
        import_scenes(Config((str(tmp_path),)))


# ---------------------------------------------------------------------------------------------- jobs/evaluate_voxels


@pytest.fixture(scope="module")
def voxel_files(tmp_path_factory, town_scenes):
    """Folders of true and reconstructed voxels.

    In the reconstructions, a tenth of the voxels is empty and some classes are changed.
    """
    root, rng, voxels = tmp_path_factory.mktemp("voxels"), np.random.default_rng(0), []
    for k, scene in enumerate(town_scenes[:4]):
        truth = voxelize(scene, VoxelGrid())
        rebuilt = np.where(rng.random(FULL) < 0.1, 0, truth)
        rebuilt[rebuilt == CLASS_ID["road"]] = rng.choice([CLASS_ID["road"], CLASS_ID["terrain"]], 1)[0]
        voxels.append((truth, rebuilt.astype(np.uint8)))
        write_voxels(str(root / f"truth/s{k}.npz"), scene)
        (root / "rebuilt").mkdir(exist_ok=True)
        np.savez_compressed(root / f"rebuilt/s{k}.npz", voxels=rebuilt.astype(np.int32))
        (root / "stored").mkdir(exist_ok=True)
        (root / f"stored/s{k}.bin").write_bytes(b"0" * (100 + 10 * k))
    return root, voxels


def test_evaluate_voxels_pools_counts_over_scenes(cluster, tmp_path, voxel_files):
    from jobs.evaluate_voxels import Config
    from jobs.implementation.evaluate_voxels import evaluate

    root, voxels = voxel_files
    config = Config(str(root / "truth"), str(root / "rebuilt"), str(root / "stored"), output=str(tmp_path))
    scores = evaluate(config)
    truth, rebuilt = (np.stack(side) for side in zip(*voxels, strict=True))
    both = ((truth > 0) & (rebuilt > 0)).sum()
    assert np.isclose(scores["voxels"]["iou"], both / ((truth > 0) | (rebuilt > 0)).sum())
    classes = {}
    for name, k in CLASS_ID.items():
        if either := ((truth == k) | (rebuilt == k)).sum():
            classes[name] = ((truth == k) & (rebuilt == k)).sum() / either
    assert scores["voxels"]["class_iou"] == pytest.approx(classes)
    assert scores["voxels"]["miou"] == pytest.approx(np.mean(list(classes.values())))
    assert 0.5 < scores["voxels"]["miou"] < 0.9 and scores["scenes"] == 4
    sizes = [(root / f"rebuilt/s{k}.npz").stat().st_size for k in range(4)]
    expected = {"mean": np.mean(sizes), "std": np.std(sizes), "min": min(sizes), "max": max(sizes)}
    assert scores["rebuilt_bytes"] == pytest.approx(expected)
    assert scores["stored_bytes"] == {"mean": 115, "std": pytest.approx(np.sqrt(125)), "min": 100, "max": 130}
    assert json.loads((tmp_path / "metrics.json").read_text()) == scores
    ((miou,),) = duckdb.sql(f"select value from '{tmp_path}/metrics.parquet' where metric = 'voxels.miou'").fetchall()
    assert miou == scores["voxels"]["miou"]
    rows = duckdb.sql(f"select * from '{tmp_path}/voxels.parquet' order by scene_id").fetchall()
    for k, (name, iou, _, size, kept) in enumerate(rows):
        confusion = compute_voxel_confusion(*voxels[k])
        filled = confusion.sum() - confusion[0, 0]
        assert (name, size, kept) == (f"s{k}", sizes[k], 100 + 10 * k)
        assert np.isclose(iou, confusion[1:, 1:].sum() / filled)


def test_evaluate_voxels_scores_perfect_reconstruction_as_1(cluster, tmp_path, town_scenes):
    from jobs.evaluate_voxels import Config
    from jobs.implementation.evaluate_voxels import evaluate

    for split, part in (("test", town_scenes[:3]), ("train", town_scenes[3:4])):
        Shard(str(tmp_path / "data"), "town", split, 0).write(part)
    for scene in read_scenes(str(tmp_path / "data"), split="test"):
        write_voxels(str(tmp_path / "rebuilt" / f"{scene.scene_id}.npz"), scene)
    config = Config(str(tmp_path / "data"), str(tmp_path / "rebuilt"), split="test", output=str(tmp_path / "out"))
    scores = evaluate(config)
    assert scores["voxels"]["iou"] == scores["voxels"]["miou"] == 1.0
    assert scores["left_out"] == {"truths": 0, "reconstructions": 0} and "stored_bytes" not in scores
    turned = evaluate(replace(config, axes=("x+", "y-", "z+")))
    assert turned["voxels"]["miou"] < 0.5
    with pytest.raises(ValueError, match=r"reconstructions lack 1 of 4 names: town-.*with --allow-missing"):
        evaluate(replace(config, split=""))
    partial = evaluate(replace(config, split="", allow_missing=True))
    assert partial["scenes"] == 3 and partial["left_out"] == {"truths": 1, "reconstructions": 0}


def test_evaluate_voxels_names_broken_and_unmatched_files(cluster, tmp_path, voxel_files):
    from jobs.evaluate_voxels import Config
    from jobs.implementation.evaluate_voxels import evaluate

    root, _ = voxel_files
    for name in ("s0", "s9"):
        save_npz(tmp_path / f"{name}.npz", np.full((64, 64, 8), 99))
    with pytest.raises(ValueError, match=r"truth lack 1 of 5 names: s9; reconstructions lack 3 of 5 names: s1, s2, s3"):
        evaluate(Config(str(root / "truth"), str(tmp_path)))
    with pytest.raises(Exception, match=r"s0\.npz: holds the class ids \[99\]"):
        evaluate(Config(str(root / "truth"), str(tmp_path), allow_missing=True))
