#!/usr/bin/env python3
"""Furnish a real place: the model puts objects on the ground of a map.

    jobs/furnish_place.py --input berlin.osm.pbf --origin 52.4737 13.4399                       192 x 192 m
    jobs/furnish_place.py --input berlin.osm.pbf --origin 52.4737 13.4399 --num-variants 4      four versions
    jobs/furnish_place.py --input berlin.osm.pbf --origin 52.4737 13.4399 52.4780 13.4292       two places
    jobs/furnish_place.py --input town.xodr --origin 120 -40 --keep-categories                  without its buildings

The job reads a square of an extract of OpenStreetMap or of an OpenDRIVE file. It keeps the ground, the buildings, and
walls and fences (--keep-categories), and generates vehicles, pedestrians, plants, poles, signs and other objects. It
writes scene tables with source=generated-<run>, one GLB file per scene (<output>/glb/<run>), pictures of each place
before and after (<output>/pictures/<run>), the scenes of the map (<output>/maps/<run>) and <run>.html, which shows both
from above. Run the same command again to resume after an interruption.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from jobs.support.cli import run
from jobs.support.options import IfBusyOption, LogFormatOption, PipelineOptions


@dataclass(frozen=True, kw_only=True)
class Config(PipelineOptions):
    input: str
    """Extract of OpenStreetMap (.osm, .osm.gz, .osm.bz2 or .osm.pbf), or an OpenDRIVE file (.xodr or .xodr.gz)."""
    origin: tuple[float, ...] = ()
    """Latitude and longitude of the middle of the place; x and y in metres for OpenDRIVE. Further pairs are further
    places (default: the point on a street that is nearest to the mean of all streets)."""
    size_m: float = 192.0
    """Side of the square in metres: at least that of a scene of the model, at most 1024, and a multiple of a latent
    cell. Each block of 64 m takes seconds."""
    heading_deg: float = 0.0
    """Direction of the x axis of the scene, in degrees clockwise from north."""
    drive_on: Literal["right", "left"] = "right"
    """Side of the road on which vehicles drive, for OpenStreetMap."""
    keep_categories: tuple[str, ...] = ("construction_big", "construction_small")
    """Categories whose objects on the map are kept: buildings, and walls and fences. The model generates none of these,
    and replaces the objects of other categories. Without names, it replaces all objects."""
    label: str = ""
    """Density label of the generated objects, such as high-medium-free (default: any-any-free, the densities follow the
    ground; models with other labels need this option)."""
    num_variants: int = 1
    """Number of different results per place."""
    output: str = ""
    """Dataset directory to write (default: $PRITTI_HOME/furnished)."""
    if_busy: IfBusyOption = "refuse"
    log_format: LogFormatOption = "text"
    run: str = "furnished"
    """Name of the run: scenes get source=generated-<run>."""


if __name__ == "__main__":
    run("furnish_place")
