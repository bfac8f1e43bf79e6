"""A short version of benchmarks/chaos.py: three kills, one of each kind."""

import json
import sys

from helpers import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))
import chaos


def test_three_kills_leave_the_tables_unchanged(tmp_path, capsys):
    log = tmp_path / "log"
    kinds = ("driver", "raylet", "worker")
    config = chaos.Config(kills=3, stores=("disk",), stages=("preprocess",), raylets=2, victims=kinds, log=str(log))
    assert chaos.main(config) == 0, capsys.readouterr().out
    records = [json.loads(line) for line in log.read_text().splitlines()]
    assert [record["killed"].split()[0] for record in records if "after" in record["killed"]] == list(kinds)
    assert not [record for record in records if record["faults"] or record["repeated"]]


def test_lost_doubled_and_changed_tables_are_faults(tmp_path):
    expected = {"scenes/a.parquet": "5 rows 01", "scenes/b.parquet": "5 rows 02", "metrics.json": "9 bytes 03"}
    found = {"scenes/a.parquet": "10 rows 04", "scenes/c.parquet": "5 rows 02", "metrics.json": "9 bytes 03"}
    assert chaos.find_faults(found, expected) == [
        "lost scenes/b.parquet",
        "added scenes/c.parquet",
        "scenes/a.parquet: 10 rows 04, not 5 rows 01",
    ]
