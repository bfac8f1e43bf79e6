"""Tests of sweeps over reference sets, samplers and numbers of steps."""

import numpy as np
import pytest

from pipelines.evaluation.reference_sweep import list_references, sweep_references
from pipelines.evaluation.sampler_sweep import (
    build_sampler_table,
    draw_sampler_charts,
    find_reference_row,
    is_as_good_as,
    make_sampler_row,
    render_sampler_html,
)
from pipelines.metrics.intervals import Estimate
from pipelines.schema.scene_subset import select_apart, select_farthest


def test_reference_sizes_fit_both_sides():
    rng = np.random.default_rng(0)
    xy, world = rng.uniform(0, 100, (200, 2)), np.zeros(200, int)
    got = list(list_references(xy, world, (10, 50, 150, 400), (30.0, 1.0, 1e-6), least=4, most=120))
    assert [(one.strategy, one.setting) for one in got][:2] == [("farthest", 10), ("farthest", 50)]
    assert [one.setting for one in got if one.strategy == "apart"] == [
        30.0
    ]  # a distance of 1 m selects more than 120 scenes
    assert np.array_equal(got[0].rows, select_farthest(xy, world, 10)) and np.array_equal(got[1].rows[:10], got[0].rows)
    assert np.array_equal(got[-1].rows, select_apart(xy, world, 30.0))


def test_reference_sweep_rejects_unfit_references():
    with pytest.raises(ValueError, match="no reference set fits 5 real and 4 generated"):
        sweep_references(np.zeros((5, 2)), np.zeros((4, 2)), np.zeros(4), [], (3,))


# -------------------------------------------------------------------------------------------------------- samplers


def make_row(sampler: str, steps: int, frechet: Estimate, cars: float = 10.0, scaling: float = 1.0) -> dict:
    validity = {name: {"generated": Estimate(0.5, 0.4, 0.6)} for name in ("road_connectivity", "overlapping")}
    counts = {"car": (20.0, cars), "tree": (50.0, 45.0), "human": (0.2, 0.0)}
    scores = {
        "scenes": {"real": 6, "generated": 6},
        "statistics": {
            f"num_{name}": {
                side: Estimate(n, n - 1, n + 1) for side, n in zip(("real", "generated"), pair, strict=True)
            }
            for name, pair in counts.items()
        },
        "layout_frechet": frechet,
        "random_frechet": frechet,
        "validity": validity | {"sunken": {"generated": None}},
    }
    scores |= {f"random_{name}_k3": Estimate(0.3, 0.2, 0.4) for name in ("precision", "recall")}
    return make_sampler_row(sampler, steps, scaling, 2.0, scores)


def test_sampler_sweep_compares_with_ddpm_of_most_steps():
    paper = make_row("ddpm", 250, Estimate(2.0, 1.5, 2.5))
    near, far = make_row("dpm++", 20, Estimate(2.8, 2.4, 3.2)), make_row("ddpm", 10, Estimate(9.0, 8.0, 10.0))
    rows = [far, paper, near]
    assert near["seconds_per_scene"] == 2 and near["layout_frechet_high"] == 3.2 and near["sunken"] is None
    assert (
        find_reference_row(rows) is paper
        and find_reference_row([near, make_row("ddim", 50, Estimate(1, 1, 1))])["steps"] == 50
    )
    assert is_as_good_as(near, paper) and not is_as_good_as(far, paper)
    assert is_as_good_as(make_row("dpm++", 20, Estimate(0.5, 0.4, 0.6)), paper)  # a better score also counts as good
    assert (near["count_category"], near["count_ratio"], near["count_ratio_low"]) == (
        "car",
        0.5,
        0.45,
    )  # there are too few humans for a ratio
    more = [make_row("dpm++", 20, Estimate(2, 1, 3), cars) for cars in (18.0, 22.0, 5.0)]
    assert [is_as_good_as(row, paper) for row in more] == [True, True, False]
    assert [row[-1] for row in build_sampler_table(rows).rows] == ["no", "–", "yes"]
    layout, page = draw_sampler_charts(rows)["layout_frechet"], render_sampler_html(rows, [], 1, ["how"])
    assert layout.series == {"ddpm": ([10, 250], [9.0, 2.0]), "dpm++": ([20], [2.8])}
    assert page.count("<svg") == 6 and "as good as ddpm with 250 steps" in page
    scaled = make_row("ddpm", 500, Estimate(2.0, 1.5, 2.5), scaling=1.01)
    assert find_reference_row([*rows, scaled]) is paper  # the reference row has no noise scaling, as in the paper
    assert build_sampler_table([*rows, scaled]).rows[-1][0] == "ddpm / 1.01"


def test_guidance_sweep_charts_fidelity_over_scale():
    def make_guided(scale: float) -> dict:
        fidelity = dict.fromkeys(
            ("vehicle_fidelity", "vehicle_fidelity_low", "vehicle_fidelity_high"), 0.5 + scale / 10
        )
        return make_row("dpm++", 20, Estimate(2, 1, 3)) | fidelity | {"guidance_scale": scale}

    rows = [make_guided(4), make_guided(1)]
    ceiling = make_row("other", 0, Estimate(0, 0, 0)) | {"steps": None}
    charts = draw_sampler_charts([*rows, ceiling])
    assert charts["vehicle_fidelity"].series == {"dpm++, 20 steps": ([1, 4], [0.6, 0.9])}
    assert charts["vehicle_fidelity"].x_label == "guidance scale" and "road_connectivity" not in charts
    assert [row[0] for row in build_sampler_table(rows).rows] == ["dpm++, guidance 4", "dpm++"]
