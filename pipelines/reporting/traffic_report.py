"""Summarise simulated traffic: the health of road networks with intervals, next to a control and a reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from pipelines.metrics.intervals import Estimate, compute_weights, make_estimate
from pipelines.reporting.report import Picture, Pictures, Section, Table, render_report_html

# Name of each score, its numerator and denominator in the table traffic, factor and meaning. None: per scene.
SCORES = (
    ("arrived", ("arrived",), "inserted", 1.0, "share of vehicles that left the scene without a teleport"),
    ("routed", ("routed",), "requested", 1.0, "share of pairs of a road in and a road out of the scene with a route"),
    (
        "unreachable_roads",
        ("unreachable_roads",),
        "roads",
        1.0,
        "share of roads on which no vehicle can drive from an entry to an exit",
    ),
    ("collisions_per_100", ("collisions",), "inserted", 100.0, "collisions between vehicles per 100 vehicles"),
    ("teleports_per_100", ("teleports",), "inserted", 100.0, "vehicles moved out of a jam, per 100 vehicles"),
    ("parked_contacts", ("parked_contacts",), "inserted", 1.0, "share of vehicles that touched a parked vehicle"),
    ("fixed_contacts", ("fixed_contacts",), "inserted", 1.0, "share of vehicles that touched another fixed object"),
    ("network_warnings", ("network_warnings",), None, 1.0, "warnings of netconvert per scene"),
    ("one_way_roads", ("one_way_roads",), None, 1.0, "roads that are too narrow for two directions, per scene"),
    ("vehicles", ("inserted",), None, 1.0, "vehicles per scene"),
)


def summarise_traffic(table: pa.Table) -> dict[str, Estimate | None]:
    """Compute the scores of a set of scenes.

    Args:
        table: Rows of the table traffic of the set; rows with a failure are left out.

    Returns:
        Scores by name with intervals over scenes; None if the denominator is 0.
    """
    rows = table.filter(table["failure"].is_null())
    if not len(rows):
        return dict.fromkeys(name for name, *_ in SCORES)
    weights, found = compute_weights(len(rows)), {}
    for name, numerators, denominator, factor, _ in SCORES:
        above = weights @ sum(rows[column].to_numpy().astype(float) for column in numerators)
        below = weights @ rows[denominator].to_numpy().astype(float) if denominator else np.ones(len(weights))
        found[name] = make_estimate(factor * above / below) if below[0] and (below > 0).all() else None
    return found


def count_simulated(table: pa.Table) -> int:
    """Count the scenes with a simulation.

    Args:
        table: Rows of the table traffic.

    Returns:
        Number of rows without a failure.
    """
    return table["failure"].null_count


def count_failures(table: pa.Table) -> dict[str, int]:
    """Count the scenes without simulation by their reason, without the names of scenes.

    Args:
        table: Rows of the table traffic.

    Returns:
        Number of scenes per reason.
    """
    counts: dict[str, int] = {}
    for name, reason in zip(table["scene_id"].to_pylist(), table["failure"].to_pylist(), strict=True):
        if reason is not None:
            reason = reason.replace(f"scene {name}", "the scene")
            counts[reason] = counts.get(reason, 0) + 1
    return counts


def render_traffic_html(
    sets: Mapping[str, pa.Table], pictures: Sequence[Picture], videos: Sequence[str], options: Mapping[str, Any]
) -> str:
    """Render the page of a simulation.

    Args:
        sets: Rows of the table traffic of each set of scenes, such as the scenes and the control.
        pictures: Pictures of scenes with traffic.
        videos: Names of the files with moving pictures.
        options: Options of the simulation.

    Returns:
        HTML page.
    """
    scores = {name: summarise_traffic(table) for name, table in sets.items()}
    shown = [[name, *(_format(found[name]) for found in scores.values())] for name, *_ in SCORES]
    sections: list[Section] = [
        Table(
            "Health of the road network",
            ("score", *(f"{name} ({count_simulated(table)} of {len(table)})" for name, table in sets.items())),
            shown,
            [meaning for *_, meaning in SCORES],
            "Values with 95 % intervals over scenes; the number of simulated scenes is in brackets. The control closes"
            " roads of the same scenes: a score that does not get worse there does not measure the network.",
        )
    ]
    failures = [[name, reason, n] for name, table in sets.items() for reason, n in count_failures(table).items()]
    if failures:
        sections.append(Table("Scenes without simulation", ("set", "reason", "scenes"), failures))
    if pictures:
        note = "Moving pictures: " + ", ".join(videos)
        sections.append(Pictures("Scenes with traffic", pictures, note=note))
    sections.append(Table("Options", tuple(options), [tuple(options.values())]))
    return render_report_html("Traffic", sections)


def _format(score: Estimate | None) -> str:
    return "–" if score is None else f"{score.value:.3g} ({score.low:.3g} to {score.high:.3g})"
