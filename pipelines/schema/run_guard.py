"""A run's name in a directory stands for one set of options: who comes with others is told so."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from pipelines.runtime import storage
from pipelines.schema.tables import TABLES


def guard_run(output: str, source: str, run: str, options: Mapping[str, object], parts: Sequence[str] = ()) -> None:
    """Keep source `source` of a dataset directory for one set of options, in `<source>.json`.

    A run that failed before it wrote a scene, or anything into the directories `parts`, gives its name free. Raises
    ValueError if the directory holds a run of that name with other options.
    """
    record = storage.join_uri(output, f"{source}.json")
    if said := find_changed_option(record, options):
        tables = [storage.join_uri(output, table, f"source={source}") for table in TABLES]
        if any(storage.list_files(place, "") for place in (tables[0], *parts)):
            raise ValueError(f"{output} holds a run {run!r} with {said}; choose another --run or --output")
        for table in tables:
            storage.delete_directory(table)
    storage.write_json(options, record)


def find_changed_option(record: str, options: Mapping[str, object]) -> str:
    """The first option that differs from those in a JSON file, in words; "" if none does, or if there is no such file."""
    asked = json.loads(json.dumps(options))
    made = storage.read_json(record) if storage.exists(record) else asked
    if made == asked:
        return ""
    name = next(key for key in sorted(made | asked) if made.get(key) != asked.get(key))
    values = [json.dumps(side.get(name)) for side in (made, asked)]
    return "{}={}, asked for {}".format(name, *values) if max(map(len, values)) < 80 else f"other {name}"
