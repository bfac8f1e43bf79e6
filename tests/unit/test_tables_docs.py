"""Tests of docs/reference/tables.md and of the descriptions in table files.

Every code block must run, queries must give the same results as Python code, and column lists must match the schemas.
The command `PYTHONPATH=tests python tests/unit/test_tables_docs.py` updates the lists of columns and categories on the
page.
"""

import json
import re
import tempfile
import textwrap
from collections import Counter
from dataclasses import replace
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from helpers import ROOT, make_straight_drive, random_scene

from models.scene import CATEGORIES, UNSET, VEGETATION, VEHICLES, Grid, Scene, make_yaw_rotation
from pipelines.editing.edit import Remove, Select
from pipelines.generation.batch_edit import EditRequest, edit_shard
from pipelines.geometry.voxels import VoxelGrid, voxelize
from pipelines.io.voxel_table import make_voxel_row, make_voxel_table
from pipelines.preprocess.sources import argoverse2, kitti360
from pipelines.preprocess.sources.town.generator import generate_town
from pipelines.preprocess.street_maps import write_street_maps
from pipelines.runtime import storage
from pipelines.schema.columns import (
    CATEGORY_MEANING,
    EDITS,
    HEIGHT_STEP_M,
    PRIMITIVES,
    RASTERS,
    REJECTS,
    SCENES,
    TRACKS,
    TRAFFIC,
    VOXELS,
    make_latents_schema,
    make_street_latents_schema,
    make_street_maps_schema,
)
from pipelines.schema.conversion import make_rejects_table
from pipelines.schema.density_labels import classify_density, compute_density_thresholds
from pipelines.schema.tables import Shard, read_scenes
from pipelines.traffic.dataset import make_tracks_table, make_traffic_row

PAGE = ROOT / "docs/reference/tables.md"
SCHEMAS = {
    "scenes": SCENES,
    "primitives": PRIMITIVES,
    "rasters": RASTERS,
    "rejects": REJECTS,
    "edits": EDITS,
    "tracks": TRACKS,
    "traffic": TRAFFIC,
    "voxels": VOXELS,
    "latents": make_latents_schema((4, 8, 8)),
    "street_latents": make_street_latents_schema((2, 8, 8)),
    "street_maps": make_street_maps_schema((2, 64, 64)),
}
SETUP, COLUMNS = "Questions", "On disk"  # headings of SQL blocks that answer no question


# ------------------------------------------------------------------------------------------- content of the page


def render_column_list(schema: pa.Schema) -> str:
    """Return a schema as a Markdown table with the types of DuckDB."""
    with tempfile.TemporaryDirectory() as folder:
        storage.write_parquet(schema.empty_table(), f"{folder}/x.parquet")
        types = {name: kind for name, kind, *_ in duckdb.sql(f"describe from '{folder}/x.parquet'").fetchall()}
    rows = ["| column | type | unit | meaning |", "|---|---|---|---|"]
    for row in json.loads(schema.metadata[b"pritti_columns"]):
        rows.append(f"| {row['name']} | {types[row['name']]} | {row['unit'] or ''} | {row['description']} |")
    return "\n".join([textwrap.fill(schema.metadata[b"pritti_description"].decode(), 120), "", *rows])


def render_category_list() -> str:
    """Return the categories as a Markdown table with the classes of each source."""
    rows = ["| category | holds | kitti360 | av2 |", "|---|---|---|---|"]
    for name, meaning in CATEGORY_MEANING.items():
        # A vegetation label with a spherical mesh becomes an ellipsoid.
        theirs = kitti360.CATEGORY_LABELS.get(name) or kitti360.CATEGORY_LABELS["vegetation_cuboid"]
        others = argoverse2.CATEGORY_LABELS.get(name, ())
        rows.append(f"| {name} | {meaning} | {', '.join(theirs)} | {', '.join(others)} |")
    return "\n".join(rows)


def update_lists(page: str) -> str:
    """Return the page with current lists of columns and categories."""
    blocks = {f"columns {name}": render_column_list(schema) for name, schema in SCHEMAS.items()}
    for name, block in (blocks | {"categories": render_category_list()}).items():
        start, end = f"<!-- {name} -->\n", "<!-- end -->"
        assert page.count(start) == 1, name
        before, after = page.split(start)
        page = before + start + block + "\n" + end + after.split(end, 1)[1]
    return page


def find_code_blocks(language: str) -> list[tuple[str, str]]:
    """Return (heading, code) of each code block of a language, in the order of the page."""
    found, heading, page = [], "", PAGE.read_text()
    for match in re.finditer(rf"^#+ ([^\n]+)$|^```{language}\n(.*?)^```", page, re.MULTILINE | re.DOTALL):
        heading = match[1] or heading
        found += [(heading, match[2])] if match[2] else []
    return found


QUESTIONS = [heading for heading, _ in find_code_blocks("sql") if heading not in (SETUP, COLUMNS)]


# -------------------------------------------------------------------------------------------------- a small town


def label_scenes_of_town(scenes: list[Scene]) -> list[Scene]:
    """Return the scenes with density labels; the thresholds come from the training split."""
    labels = {}
    for name, group in (("vegetation_density", VEGETATION), ("vehicle_density", VEHICLES)):
        count = np.array([np.isin(s.category, group).sum() for s in scenes])
        volume = np.array([s.volume_m3[np.isin(s.category, group)].sum() for s in scenes])
        training = np.array([s.split == "train" for s in scenes])
        labels[name] = classify_density(
            count, volume, compute_density_thresholds(count[training], volume[training])
        ).tolist()
    return [replace(s, **{name: labels[name][k] for name in labels}) for k, s in enumerate(scenes)]


def make_generated_scene(scene: Scene, index: int) -> Scene:
    """Return a substitute for a generated scene.

    The scene has one third of the primitives of a real scene, scaled by 0.8.
    """
    some = scene.select(np.arange(index % 3, len(scene), 3))
    return replace(
        some,
        scene_id=f"generated-docs-0-{index:07d}",
        source="generated-docs",
        split="generated",
        sequence="0",
        frame=index,
        size_m=some.size_m * np.float32(0.8),
        existence=np.linspace(0.3, 1, len(some), dtype=np.float32),
        heading_rad=UNSET,
        instance_id=UNSET,
        label=UNSET,
        world_xyz_m=(0.0, 0.0, 0.0),
        world_yaw_rad=0.0,
        world_from_imu=None,
        vehicle_density=None,
    )


@pytest.fixture(scope="module")
def town() -> list[Scene]:
    """Scenes of two drives.

    The first drive has training and test scenes; the second drive has only training scenes.
    """
    drives = [generate_town(seed) for seed in (0, 1)]
    plan = [(0, k, "train" if k < 10 else "test") for k in range(16)] + [(1, k, "train") for k in range(8)]
    return label_scenes_of_town([drives[d].scene(k, split) for d, k, split in plan])


@pytest.fixture(scope="module")
def generated_scenes(town) -> list[Scene]:
    return [make_generated_scene(scene, k) for k, scene in enumerate(town[::4])]


@pytest.fixture(scope="module")
def rejects() -> list[dict]:
    rows = [(3, "nothing is annotated in the crop"), (9, "nothing is annotated in the crop"), (None, "is broken")]
    return [{"scene_id": f"town-7-{f}", "sequence": "7", "frame": f, "reason": reason} for f, reason in rows]


@pytest.fixture(scope="module")
def root(town, generated_scenes, rejects, tmp_path_factory) -> Path:
    """Folder with `real` and `generated`. These paths replace `DIR` and `GENERATED` of the page."""
    path = tmp_path_factory.mktemp("tables")
    for split in ("train", "test"):
        for number, sequence in enumerate(sorted({s.sequence for s in town if s.split == split})):
            members = [s for s in town if (s.split, s.sequence) == (split, sequence)]
            Shard(f"{path}/real", "town", split, number).write(members)
    Shard(f"{path}/generated", "generated-docs", "generated", 0).write(generated_scenes)
    shard = Shard(f"{path}/real", "town", "train", 0)
    storage.write_parquet(make_rejects_table(rejects), shard.path("rejects"))
    _, changes = edit_shard(town[0], EditRequest((Remove(Select(where="length_m > 3")),), "", "docs"))
    storage.write_parquet(pa.concat_tables(changes), shard.path("edits"))
    moments = pa.FixedShapeTensorArray.from_numpy_ndarray(np.zeros((len(shard.scenes()), 4, 8, 8), np.float16))
    ids = shard.read("scenes", ["scene_id"])["scene_id"].combine_chunks()
    storage.write_parquet(pa.table([ids, moments, moments], schema=SCHEMAS["latents"]), shard.path("latents"))
    grounds, cells = (np.zeros((len(ids), *shape)) for shape in ((2, 8, 8), (8, 8)))
    tensors = map(pa.FixedShapeTensorArray.from_numpy_ndarray, (grounds.astype(np.float16), cells.astype(np.uint8)))
    streets = pa.table([ids, *tensors], schema=SCHEMAS["street_latents"])
    storage.write_parquet(streets, shard.path("street_latents"))
    storage.write_parquet(make_tracks_table(ids[0].as_py(), make_straight_drive()), shard.path("tracks"))
    row = make_traffic_row(ids[0].as_py(), False, None, "the scene has no road")
    storage.write_parquet(pa.Table.from_pylist([row], schema=TRAFFIC), shard.path("traffic"))
    voxels = [make_voxel_row(s.scene_id, voxelize(s, VoxelGrid(s.grid)), VoxelGrid(s.grid), ()) for s in town[:1]]
    storage.write_parquet(make_voxel_table(voxels), shard.path("voxels"))
    write_street_maps([random_scene(0, grid=Grid(256.0, 128.0, 0.5, 512, 512))], shard)
    return path


def replace_folders(code: str, root: Path) -> str:
    return code.replace("GENERATED", f"{root}/generated").replace("DIR", f"{root}/real")


@pytest.fixture(scope="module")
def answers(root) -> dict[str, pd.DataFrame]:
    """Result of DuckDB for each SQL block, by heading."""
    connection = duckdb.connect()
    found = {}
    for heading, sql in find_code_blocks("sql"):
        found[heading] = connection.execute(replace_folders(sql, root)).df()
    return found


def test_tables_page_lists_equal_schemas():
    page = PAGE.read_text()
    assert page == update_lists(page), "run python tests/unit/test_tables_docs.py"


@pytest.mark.parametrize("question", QUESTIONS)
def test_tables_page_queries_return_rows(answers, question):
    answer = answers[question]
    assert len(answer) and not answer.isna().all().any()


# ---------------------------------------------------------------------------------------------- query results


def select_answer(answers: dict[str, pd.DataFrame], words: str, *index: str) -> pd.DataFrame:
    """Return the result of the query whose heading contains `words`, indexed by the columns `index`."""
    (question,) = [q for q in QUESTIONS if words in q]
    return answers[question].set_index(list(index)).sort_index()


def group_by_drive(scenes: list[Scene]) -> dict[str, list[Scene]]:
    """Group scenes by sequence, in driving order."""
    ordered = sorted(scenes, key=lambda s: (s.sequence, s.frame))
    return {name: [s for s in ordered if s.sequence == name] for name in sorted({s.sequence for s in scenes})}


def compute_steps_m(drive: list[Scene]) -> np.ndarray:
    return np.linalg.norm(np.diff([s.world_xyz_m[:2] for s in drive], axis=0), axis=1)


def compute_world_m(scene: Scene) -> np.ndarray:
    """Return the centres (n, 3) of the primitives in the world frame (m)."""
    return scene.center_m.astype(float) @ make_yaw_rotation(scene.world_yaw_rad).T + scene.world_xyz_m


def select_categories(scene: Scene, *names: str) -> np.ndarray:
    """Return a mask (n,) of the primitives in the named categories."""
    return np.isin(scene.category, [CATEGORIES.index(name) for name in names])


def test_tables_page_trees_per_kilometer(answers, town):
    answer = select_answer(answers, "How many trees", "sequence")
    for sequence, drive in group_by_drive(town).items():
        trees = {i for s in drive for i in s.instance_id[np.isin(s.category, VEGETATION) & (s.size_m[:, 2] >= 3)]}
        km = (np.minimum(compute_steps_m(drive), 64).sum() + 64) / 1000
        assert answer.trees[sequence] == len(trees) > 20
        assert abs(answer.trees_per_km[sequence] - len(trees) / km) <= 0.5
    assert len(answer) == 2


def test_tables_page_ground_shares(answers, town, generated_scenes):
    answer = select_answer(answers, "Which ground classes", "source", "vehicle_density")
    for label in {s.vehicle_density for s in town}:
        share = np.mean([s.ground_area_m2() for s in town if s.vehicle_density == label], axis=0) / 64**2
        for name, expected in zip(town[0].ground_classes, share, strict=True):
            if name != "ground":
                assert abs(answer[f"{name}_percent"]["town", label] - 100 * expected) <= 0.051
    assert answer.scenes.sum() == len(town) + len(generated_scenes)


def test_tables_page_cluttered_sidewalks(answers, town):
    answer = select_answer(answers, "How cluttered", "sequence")
    for sequence, drive in group_by_drive(town).items():
        things = sum(select_categories(s, "pole", "traffic_control", "object").sum() for s in drive)
        sidewalk_m2 = sum(s.ground_area_m2()[1] for s in drive)
        assert abs(answer.objects_per_1000_m2[sequence] - 1000 * things / sidewalk_m2) <= 0.051


def test_tables_page_pole_heights(answers, town):
    answer = select_answer(answers, "How high are poles", "label")
    heights = {
        (s.label[k], s.sequence, s.instance_id[k]): s.size_m[k, 2]
        for s in town
        for k in np.flatnonzero(select_categories(s, "pole"))
    }
    for label in {key[0] for key in heights}:
        values = [height for key, height in heights.items() if key[0] == label]
        expected = np.quantile(values, [0.05, 0.5, 0.95])
        assert answer.poles[label] == len(values)
        assert np.allclose(answer.loc[label, ["p05_m", "p50_m", "p95_m"]].astype(float), expected, atol=0.006)


def test_tables_page_drive_lengths(answers, town):
    answer = select_answer(answers, "How long are the drives", "sequence")
    for sequence, drive in group_by_drive(town).items():
        steps = compute_steps_m(drive)
        expected = len(drive), steps.sum().round(), np.median(steps), steps.max()
        columns = ["scenes", "length_m", "step_p50_m", "longest_gap_m"]
        assert np.allclose(answer.loc[sequence, columns].astype(float), expected, atol=0.006)


def test_tables_page_parked_cars(answers, town):
    lateral_m = []
    for drive in group_by_drive(town).values():
        seen: dict[int, list[tuple]] = {}
        for s in drive:
            for k in np.flatnonzero(select_categories(s, "vehicle_small")):
                seen.setdefault(s.instance_id[k], []).append((*s.center_m[k, :2], *compute_world_m(s)[k, :2]))
        for rows in map(np.array, seen.values()):
            if len(rows) > 1 and (np.ptp(rows[:, 2:], axis=0) < 0.5).all() and rows[:, 0].min() < 15:
                lateral_m.append(rows[rows[:, 0].argmin(), 1])
    lateral_m = np.array(lateral_m)
    answer = select_answer(answers, "parked cars", "side")
    for side, sign in (("left", 1), ("right", -1)):
        offset_m = lateral_m[(lateral_m * sign > 0) & (np.abs(lateral_m) < 15)] * sign
        assert answer.cars[side] == len(offset_m) > 3
        expected = np.quantile(offset_m, [0.05, 0.5, 0.95])
        assert np.allclose(answer.loc[side, ["p05_m", "p50_m", "p95_m"]].astype(float), expected, atol=0.051)


def test_tables_page_objects_visible_in_next_scene(answers, town):
    seen_again, moved, mistaken = Counter(), Counter(), Counter()
    for drive in group_by_drive(town).values():
        for a, b in zip(drive, drive[1:], strict=False):
            same_object = (a.instance_id[:, None] == b.instance_id) & (a.label[:, None] == b.label)
            same_object &= a.category[:, None] == b.category
            same_place = (np.abs(compute_world_m(a)[:, None] - compute_world_m(b)) < 0.1).all(axis=2)
            same_place &= a.category[:, None] == b.category
            seen_again.update(a.category[np.nonzero(same_object)[0]].tolist())
            moved.update(a.category[np.nonzero(same_object & ~same_place)[0]].tolist())
            mistaken.update(a.category[np.nonzero(same_place & ~same_object)[0]].tolist())
    answer = select_answer(answers, "visible from the next", "category")
    for k, name in enumerate(CATEGORIES):
        if name in answer.index:
            assert answer.loc[name].tolist() == [seen_again[k], moved[k], mistaken[k]]
    assert answer.seen_again.sum() == seen_again.total() > 1000 and answer.moved.sum() > 0


def test_tables_page_scene_contents(answers, town, generated_scenes):
    answer = select_answer(answers, "What is in a scene", "source", "category")
    assert np.isclose(answer.per_scene["town"].sum(), np.mean([len(s) for s in town]), atol=0.06)
    for source, scenes in (("town", town), ("generated-docs", generated_scenes)):
        sizes = np.concatenate([s.size_m[select_categories(s, "vehicle_small")] for s in scenes])
        row = answer.loc[source, "vehicle_small"].astype(float)
        assert np.allclose(row, [len(sizes) / len(scenes), *np.median(sizes, axis=0)], atol=0.006)


def test_tables_page_compares_generated_with_real(answers, town, generated_scenes):
    answer = select_answer(answers, "Do generated scenes", "category")
    for name in answer.index:
        for side, scenes in (("real", town), ("generated", generated_scenes)):
            heights = np.concatenate([s.size_m[select_categories(s, name), 2] for s in scenes])
            assert np.isclose(answer[f"{side}_per_scene"][name], len(heights) / len(scenes), atol=0.006)
            if len(heights):
                assert np.isclose(answer[f"{side}_height_m"][name], np.median(heights), atol=0.006)


def test_tables_page_label_combinations(answers, town):
    answer = select_answer(answers, "density labels", "source", "split", "vegetation_density", "vehicle_density")
    training = Counter((s.vegetation_density, s.vehicle_density) for s in town if s.split == "train")
    assert {key[2:]: n for key, n in answer.scenes.items() if key[1] == "train"} == training
    assert np.isclose(answer.percent["town", "train"].sum(), 100, atol=0.5)


def test_tables_page_nearest_training_pose(answers, town):
    answer = select_answer(answers, "How close are test scenes", "sequence")
    place = {split: [s.world_xyz_m[:2] for s in town[:16] if s.split == split] for split in ("train", "test")}
    nearest_m = np.linalg.norm(np.array(place["test"])[:, None] - np.array(place["train"]), axis=2).min()
    assert answer.loc[town[0].sequence, ["test_scenes", "nearest_m"]].tolist() == pytest.approx(
        [6, nearest_m], abs=0.006
    )
    assert len(answer) == 1


def test_tables_page_reject_reasons(answers, rejects):
    answer = select_answer(answers, "Which scenes were left out", "reason")
    assert answer.scenes.to_dict() == Counter(row["reason"] for row in rejects)


# ------------------------------------------------------------------------------------------------------- Python


def test_tables_page_python_blocks_run(root, town, capsys):
    voxels, decoder, script = (code for _, code in find_code_blocks("python"))
    exec(replace_folders(voxels, root), {})
    assert decoder.split("\n\n\n")[1].strip() in script
    names: dict = {}
    exec(replace_folders(script, root), names)
    along = names["along"]
    assert "road_width_m" in capsys.readouterr().out
    drive = max(group_by_drive(town).values(), key=len)
    assert along.index.tolist() == [s.scene_id for s in drive]
    assert np.isclose(along.distance_m.iloc[-1], compute_steps_m(drive).sum())
    x_m = drive[0].grid.x_m()
    for scene, row in zip(drive, along.itertuples(), strict=True):
        road, height_m = scene.occupied[0], scene.height_m[0]
        bands = [(x_m > 5) & (x_m < 15), (x_m > 35) & (x_m < 45)]
        levels_m = [np.median(height_m[band][road[band]]) for band in bands if road[band].any()]
        assert row.road_width_m == np.median(road[bands[0]].sum(axis=1)) * 0.25
        if len(levels_m) == 2:
            assert abs(row.climb_percent - 100 * np.subtract(*levels_m[::-1]) / 30) <= 100 * HEIGHT_STEP_M / 30
    rasters = pd.read_parquet(root / "real/rasters").set_index("scene_id")
    exec(decoder, names)
    for scene in town[::5]:
        height_m, occupied = names["ground"](rasters.loc[scene.scene_id])
        assert np.array_equal(occupied, scene.occupied)
        assert np.abs(height_m - scene.height_m).max() <= HEIGHT_STEP_M / 2 + 1e-5


# ----------------------------------------------------------------------------------- descriptions in files


def assert_columns_are_described(path: str, schema: pa.Schema):
    """Assert that each field has a description in Arrow and in the key-value metadata that DuckDB reads."""
    written = pq.read_schema(path)
    assert written.names == schema.names
    for field in written:
        stored = {k.decode(): v.decode() for k, v in field.metadata.items() if not k.startswith(b"PARQUET:")}
        assert stored.pop("description").endswith(".") and set(stored) <= {"unit", "default"}, field.name
        assert stored.get("unit", "").encode() == schema.field(field.name).metadata.get(b"unit", b"")
    pairs = duckdb.sql(
        f"select decode(key), decode(value) from parquet_kv_metadata('{path}') where key <> 'ARROW:schema'"
    )
    stored = dict(pairs.fetchall())
    assert stored == {k.decode(): v.decode() for k, v in schema.metadata.items()}
    columns = json.loads(stored["pritti_columns"])
    assert [row["name"] for row in columns] == schema.names
    for row in columns:
        metadata = schema.field(row["name"]).metadata
        assert metadata[b"description"].decode() == row["description"]
        assert metadata.get(b"unit", b"").decode() == (row["unit"] or "")


@pytest.mark.parametrize("table", SCHEMAS)
def test_table_files_describe_their_columns(root, table):
    path = Shard(f"{root}/real", "town", "train", 0).path(table)
    assert_columns_are_described(path, SCHEMAS[table])
    names = {name for (name,) in duckdb.sql(f"select name from parquet_schema('{path}')").fetchall()}
    assert names >= set(SCHEMAS[table].names)


def test_table_units_match_column_names():
    for schema in SCHEMAS.values():
        for field in schema:
            suffix = re.search(r"_(m|m2|m3|rad)$", field.name)
            if suffix:
                assert field.metadata[b"unit"].decode() == suffix[1], field.name


def test_label_scenes_keeps_column_descriptions(root, tmp_path):
    """The function label_scenes, the last step of preprocessing, rewrites the scenes tables."""
    from pipelines.schema.dataset import label_scenes

    staged = Shard(f"{root}/real", "town", "train", 0).read("scenes")
    thresholds = compute_density_thresholds(np.arange(4), np.arange(4.0))
    final = str(tmp_path / "final.parquet")
    storage.write_parquet(label_scenes(staged, thresholds, thresholds).cast(SCENES), final)
    assert_columns_are_described(final, SCENES)


def test_duckdb_lists_table_columns(answers):
    listed = answers[COLUMNS].set_index("name")
    assert listed.index.tolist() == SCENES.names
    assert listed.unit["x_m"] == "m" and listed.description["x_m"].startswith("x of the scene's origin")


def test_shard_reads_files_without_descriptions(tmp_path):
    """Files without descriptions are readable, both alone and together with files that have descriptions."""
    old, new = (Shard(str(tmp_path), "town", "train", k) for k in (0, 1))
    old.write([random_scene(0)])
    new.write([random_scene(1)])
    for name in ("scenes", "primitives", "rasters"):
        table = old.read(name)
        bare = pa.schema([pa.field(f.name, f.type) for f in table.schema])
        storage.write_parquet(table.replace_schema_metadata(None).cast(bare), old.path(name))
        assert not pq.read_schema(old.path(name)).metadata
        assert len(pa.concat_tables([old.read(name), new.read(name)])) > 1
    assert [s.scene_id for s in read_scenes(str(tmp_path))] == ["test-0000", "test-0001"]


if __name__ == "__main__":
    PAGE.write_text(update_lists(PAGE.read_text()))
