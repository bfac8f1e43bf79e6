"""Bind a directory, or a run's name in it, to one set of options, recorded in a JSON file."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence

from pipelines.runtime import storage
from pipelines.schema.tables import TABLES


def guard_options(
    record: str,
    options: Mapping[str, object],
    is_in_use: Callable[[], bool],
    discard: Callable[[], None],
    describe: Callable[[str], str],
) -> None:
    """Record options; if the record holds other options, discard their results unless these are in use.

    Args:
        record: JSON file with the options.
        options: Options of this run, as JSON can hold them.
        is_in_use: Whether a run with the recorded options has written results, which must be kept.
        discard: Deletes the rest of a run with other options.
        describe: Makes the error message from the first option that differs ("seed=1, asked for 2").

    Raises:
        ValueError: The record holds other options and is in use.
    """
    if difference := find_changed_option(record, options):
        if is_in_use():
            raise ValueError(describe(difference))
        discard()
    storage.write_json(options, record)


def guard_run(output: str, source: str, run: str, options: Mapping[str, object], parts: Sequence[str] = ()) -> None:
    """Bind source `source` of a dataset directory to one set of options, in `<source>.json`.

    Args:
        output: Dataset directory.
        source: Value of the source column, such as generated-<run>.
        run: Name of the run.
        options: Its options.
        parts: Further directories of the run. A run that wrote neither a scene nor a file there can be replaced.

    Raises:
        ValueError: The directory holds a run of that name with other options.
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
    """Describe the first option that differs from those in a JSON file; "" if none does or there is no such file."""
    return compare_options(storage.read_json(record), options) if storage.exists(record) else ""


def compare_options(recorded: Mapping[str, object], options: Mapping[str, object]) -> str:
    """Describe the first option that differs from the recorded ones, such as "seed=1, asked for 2"; "" if none does."""
    recorded, asked = dict(recorded), json.loads(json.dumps(options))
    if recorded == asked:
        return ""
    name = next(key for key in sorted(recorded | asked) if recorded.get(key) != asked.get(key))
    values = [json.dumps(side.get(name)) for side in (recorded, asked)]
    return "{}={}, asked for {}".format(name, *values) if max(map(len, values)) < 80 else f"other {name}"
