"""Bind a directory or a run name to one set of options. A JSON file records the options."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence

from pipelines.runtime import storage
from pipelines.schema.columns import TABLES
from pipelines.schema.scene_subset import SceneSubset
from pipelines.schema.tables import Shard


def guard_options(
    record: str,
    options: Mapping[str, object],
    is_in_use: Callable[[], bool],
    discard: Callable[[], None],
    describe: Callable[[str], str],
) -> None:
    """Record the options of a run, or raise an error if results with other options exist.

    If the file records other options and the results of that run are not in use, the function deletes the results. It
    then records the new options.

    Args:
        record: Path of the JSON file with the options.
        options: Options of this run; values must be valid in JSON.
        is_in_use: Function that returns whether the run with the recorded options has results that must be kept.
        discard: Function that deletes the incomplete results of an earlier run with different options.
        describe: Function that returns the error message for a difference such as "seed=1, asked for 2".

    Raises:
        ValueError: The file records other options, and the results of that run are in use.
    """
    if difference := find_changed_option(record, options):
        if is_in_use():
            raise ValueError(describe(difference))
        discard()
    storage.write_json(options, record)


def guard_tables(
    output: str, name: str, tables: Sequence[str], options: Mapping[str, object], selection: SceneSubset
) -> None:
    """Bind tables that follow from scenes to one set of options, for each source and split.

    The file `<name>-<source>-<split>.json` of the output records the options and the scenes.

    Args:
        output: Dataset directory of the tables.
        name: What the tables hold, for file names and messages.
        tables: Names of the tables.
        options: Options of this run; values must be valid in JSON.
        selection: Scenes.

    Raises:
        ValueError: The output contains tables of these scenes with other options, or of other scenes.
    """
    groups: dict[tuple[str, str], list] = {}
    for (shard, _), found in zip(selection.shards(), selection.files(), strict=True):
        groups.setdefault((shard.source, shard.split), []).append(found)
    for (source, split), files in groups.items():
        places = [Shard(output, source, split, 0).place(table) for table in tables]
        guard_options(
            storage.join_uri(output, f"{name}-{source}-{split}.json"),
            {**options, "scenes": files},
            is_in_use=lambda places=places: any(storage.list_files(place, "") for place in places),
            discard=lambda: None,
            describe=lambda difference: f"{output} holds {name} with {difference}; choose another --output",
        )


def guard_run(output: str, source: str, run: str, options: Mapping[str, object], parts: Sequence[str] = ()) -> None:
    """Bind a run name to one set of options.

    The file `<source>.json` of the dataset directory records the options.

    Args:
        output: Dataset directory.
        source: Value of the source column, such as generated-<run>.
        run: Run name.
        options: Options of this run; values must be valid in JSON.
        parts: Additional output directories of the run. An earlier run with other options is replaced only if it wrote
            neither a scene nor a file in these directories.

    Raises:
        ValueError: The directory holds a run of the same name with other options.
    """
    tables = [storage.join_uri(output, table, f"source={source}") for table in TABLES]

    def delete_tables() -> None:
        for table in tables:
            storage.delete_directory(table)

    guard_options(
        storage.join_uri(output, f"{source}.json"),
        options,
        is_in_use=lambda: any(storage.list_files(place, "") for place in (tables[0], *parts)),
        discard=delete_tables,
        describe=lambda difference: f"{output} holds a run {run!r} with {difference}; choose another --run or --output",
    )


def find_changed_option(record: str, options: Mapping[str, object]) -> str:
    """Describe the first option that differs from the options in a JSON file.

    Args:
        record: Path of the JSON file; the file may be absent.
        options: Options of this run.

    Returns:
        Description such as "seed=1, asked for 2". The string is empty if all options agree or the file is absent.
    """
    return compare_options(storage.read_json(record), options) if storage.exists(record) else ""


def compare_options(recorded: Mapping[str, object], options: Mapping[str, object]) -> str:
    """Describe the first option that differs from the recorded options.

    Args:
        recorded: Options of the earlier run.
        options: Options of this run.

    Returns:
        Description such as "seed=1, asked for 2" of the alphabetically first difference. The string is empty if all
        options agree.
    """
    recorded, asked = dict(recorded), json.loads(json.dumps(options))
    if recorded == asked:
        return ""
    name = next(key for key in sorted(recorded | asked) if recorded.get(key) != asked.get(key))
    values = [json.dumps(side.get(name)) for side in (recorded, asked)]
    return "{}={}, asked for {}".format(name, *values) if max(map(len, values)) < 80 else f"other {name}"
