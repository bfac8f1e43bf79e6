"""Tests of traffic on streets, simulated with SUMO."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.evaluation.traffic import simulate_traffic
from pipelines.preprocess.sources.town.version2.town import make_large_scene
from pipelines.traffic import sumo
from pipelines.traffic.sumo import find_sumo

needs_sumo = pytest.mark.skipif(find_sumo() is None, reason="needs SUMO (extra traffic)")


@pytest.fixture(scope="module")
def town():
    return make_large_scene(1, 160.0, resolution_m=0.5)


@needs_sumo
def test_vehicles_arrive_in_town_and_not_on_cut_streets(town):
    whole = simulate_traffic(town, num_vehicles=60)
    assert whole.requested == 60 and whole.routed >= 55 and whole.arrived_share > 0.95
    road = town.ground_classes.index("road")
    occupied = town.occupied.copy()
    occupied[road, ::40] = occupied[road, :, ::40] = False  # A gap of 0.5 m every 20 m.
    cut = simulate_traffic(replace(town, occupied=occupied), num_vehicles=60)
    assert cut.routed < 0.5 * whole.routed


def test_scene_without_road_is_refused(town):
    if find_sumo() is not None:
        with pytest.raises(ValueError, match="has no road to export"):
            simulate_traffic(replace(town, occupied=np.zeros_like(town.occupied)))


def test_missing_sumo_is_reported(town, monkeypatch):
    monkeypatch.setattr(sumo, "find_sumo", lambda: None)
    with pytest.raises(RuntimeError, match=r"install the extra traffic \(pip install 'pritti-on-ray\[traffic\]'\)"):
        simulate_traffic(town)
