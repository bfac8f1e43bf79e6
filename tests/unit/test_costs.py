"""Tests of the cost model against calculations by hand and against published FLOP counts."""

import json
import sys

import pytest
from helpers import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))
from cost_rates import RATES, Usage, count_requests, make_rate
from costs import Config, Row, Work, count_dit_flops, estimate, format_table

RATE = {"cpu_s": 3.6, "writes": 0.5, "reads": 2.0, "stored_bytes": 1e6}
STAGES = ("preprocess", "encode", "sample", "evaluate", "outpaint")
WORK = Work(lvae_step=3e9, encode=1e9, decode=1e9, dit_step=3e9, denoise=1e9, lvae_weights=10, dit_weights=10)


def test_price_is_the_sum_of_its_parts():
    row = Row("p", "s", "u", gpu_hours=10, cpu_hours=100, writes=2e6, reads=3e6, gigabytes=50)
    assert row.price(Config()) == pytest.approx(10 * 2 + 100 * 0.04 + 2000 * 0.005 + 3000 * 0.0004 + 50 * 0.023)


def test_stages_equal_calculations_by_hand():
    config = Config(gpu_tflops=1.0, utilisation=0.5, scenes=1800, city_km2=1.024, num_inference_steps=250)
    rows = {(row.project.split(",")[0], row.stage): row for row in estimate(config, WORK, dict.fromkeys(STAGES, RATE))}
    assert len(rows) == 11
    preprocess, sample = rows["KITTI-360", "preprocess"], rows["1", "sample"]
    assert preprocess.cpu_hours == pytest.approx(63_146 * 3.6 / 3600) and preprocess.gigabytes == pytest.approx(63.146)
    # 251 billion operations per scene, at 0.5 TFLOP/s: half a second.
    assert sample.gpu_hours == pytest.approx(1800 * 251e9 / 0.5e12 / 3600) and sample.cpu_hours == 0
    outpaint = rows["city", "outpaint"]
    assert outpaint.units.startswith("1,000 blocks")
    assert outpaint.gpu_hours == pytest.approx(1000 * (2410 * 1e9 + 2e9) / 0.5e12 / 3600)  # 2,410: the paper's RePaint
    training = rows["KITTI-360", "train LVAE"]
    assert training.gpu_hours == pytest.approx(300_000 * 32 * 3e9 / 0.5e12 / 3600)
    assert "(paper: 72)" in format_table(list(rows.values()), config)


def test_flops_of_dit_equal_published_counts():
    """DiT-B/2 on a latent of 32 x 32 has 23.0 billion multiply-adds (Peebles and Xie 2023, table 4)."""
    _, denoise = count_dit_flops("kitti360", channels=64, size=32)
    assert denoise == pytest.approx(2 * 23.0e9, rel=0.02)


def test_page_holds_the_measured_stages():
    rows = format_table(list(estimate(Config(), WORK, json.loads(RATES.read_text())["per_unit"])), Config()).split("\n")
    page = (ROOT / "docs/reference/costs.md").read_text()
    measured = [row for row in rows if "preprocess" in row or "evaluate" in row]
    assert len(measured) == 3 and all(row in page for row in measured)


def test_rates_exclude_what_both_runs_need(tmp_path):
    few, many = Usage(10, 50.0, 7, 100, 1000), Usage(30, 60.0, 17, 300, 5000)
    assert make_rate(few, many) == {"cpu_s": 0.5, "writes": 0.5, "reads": 10.0, "stored_bytes": 200.0}
    log = tmp_path / "log"
    lines = [
        '"PUT /b/a HTTP/1.1" 200',
        '"GET /b/a HTTP/1.1" 206',
        '"HEAD /b/a HTTP/1.1" 200',
        '"POST /b/?delete= HTTP/1.1"',
    ]
    log.write_text("\n".join(f"127.0.0.1 - - [date] {line} -" for line in lines))
    assert count_requests(log) == {"write": 1, "read": 2, "delete": 1}
