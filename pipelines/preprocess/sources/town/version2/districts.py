"""Parameters of the districts of version 2 of the town, and their variation between blocks and rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Range = tuple[float, float]


@dataclass(frozen=True)
class District:
    """Parameters of one kind of neighbourhood.

    Shares are probabilities. Names with `per_100m` are intensities per length of a row along a street.
    """

    house_scale: tuple[float, float, float]
    setback_m: Range  # Distance from the sidewalk to the building line of a row.
    gap_m: Range  # Free width on each side of a detached house.
    behind_m: Range  # Depth of the annotated ground behind the houses of a row.
    terraces: float  # Share of rows whose houses touch.
    perimeters: float  # Share of blocks whose houses touch and stand near the sidewalk on all sides.
    courts: float  # Share of rows with a car park in front of large houses.
    greens: float  # Share of rows without houses.
    vacant: float  # Share of plots without a house.
    garages: float
    driveways: float  # Share of plots with a driveway.
    driveway_cars: float
    paved_fronts: float  # Share of front yards that are paved.
    lawn: float  # Share of rows with annotated ground between the buildings.
    ground_below: float  # Share of rows whose annotated ground continues below the houses.
    sidewalk_m: Range
    sidewalks: float
    bays: float  # Share of sides with parking bays.
    kerb_rows: float  # Share of sides with cars along the kerb.
    kerb_cars: float  # Share of occupied places in a row of cars along the kerb.
    hedges: float  # Share of plot borders that are hedges.
    walls: float  # Share of plot borders that are walls.
    steps_per_plot: float  # Number of low walls at driveways and doors.
    shrubs_per_100m: float
    bushes_per_100m: float
    trees_per_100m: float
    tree_scale: float
    avenues: float  # Share of sides with a row of trees.
    lamps: float  # Share of poles for lamps that carry a lamp.
    lamp_spacing_m: float
    passages: float  # Share of houses with a paved strip at one side.
    patches_per_100m: float  # Number of small patches of ground: tree pits and landings.
    signs: float  # Share of ends of a side with a sign.
    lights: float  # Share of junctions with traffic lights.
    objects_per_plot: float
    bicycles_per_plot: float
    people_per_100m: float
    trucks: float  # Share of free places along the kerb with a truck or bus.


DISTRICTS = {
    "centre": District(
        house_scale=(1.16, 1.14, 0.9),
        setback_m=(0.3, 2.0),
        gap_m=(0.5, 1.4),
        behind_m=(-8.9, -3.2),
        terraces=0.12,
        perimeters=0.12,
        courts=0.12,
        greens=0.02,
        vacant=0.04,
        garages=0.7,
        driveways=0.6,
        driveway_cars=0.8,
        paved_fronts=0.55,
        lawn=0.71,
        ground_below=0.5,
        sidewalk_m=(2.3, 3.1),
        sidewalks=0.97,
        bays=0.03,
        kerb_rows=0.9,
        kerb_cars=0.78,
        hedges=0.38,
        walls=0.45,
        steps_per_plot=1.6,
        shrubs_per_100m=12.6,
        bushes_per_100m=4.7,
        trees_per_100m=4.4,
        tree_scale=0.95,
        avenues=0.32,
        lamps=0.5,
        lamp_spacing_m=30.0,
        passages=0.9,
        patches_per_100m=4.5,
        signs=0.3,
        lights=0.05,
        objects_per_plot=0.25,
        bicycles_per_plot=0.05,
        people_per_100m=0.05,
        trucks=0.01,
    ),
    "suburb": District(
        house_scale=(1.12, 1.1, 0.85),
        setback_m=(1.1, 3.8),
        gap_m=(0.5, 1.8),
        behind_m=(-8.3, -0.1),
        terraces=0.07,
        perimeters=0.02,
        courts=0.2,
        greens=0.04,
        vacant=0.04,
        garages=0.8,
        driveways=0.9,
        driveway_cars=0.8,
        paved_fronts=0.3,
        lawn=1.0,
        ground_below=0.95,
        sidewalk_m=(1.55, 2.25),
        sidewalks=0.92,
        bays=0.06,
        kerb_rows=0.8,
        kerb_cars=0.61,
        hedges=0.6,
        walls=0.62,
        steps_per_plot=3.55,
        shrubs_per_100m=64.2,
        bushes_per_100m=34.4,
        trees_per_100m=28.9,
        tree_scale=0.95,
        avenues=0.15,
        lamps=0.9,
        lamp_spacing_m=28.0,
        passages=1.0,
        patches_per_100m=5.5,
        signs=0.83,
        lights=0.1,
        objects_per_plot=0.92,
        bicycles_per_plot=0.05,
        people_per_100m=0.05,
        trucks=0.012,
    ),
    "green": District(
        house_scale=(1.14, 1.12, 0.85),
        setback_m=(2.4, 5.5),
        gap_m=(1.2, 4.5),
        behind_m=(-5.4, 3.3),
        terraces=0.03,
        perimeters=0.0,
        courts=0.04,
        greens=0.15,
        vacant=0.15,
        garages=0.6,
        driveways=0.65,
        driveway_cars=0.66,
        paved_fronts=0.12,
        lawn=1.0,
        ground_below=0.9,
        sidewalk_m=(1.45, 2.05),
        sidewalks=0.9,
        bays=0.1,
        kerb_rows=0.65,
        kerb_cars=0.31,
        hedges=0.6,
        walls=0.58,
        steps_per_plot=3.85,
        shrubs_per_100m=59.7,
        bushes_per_100m=33.4,
        trees_per_100m=29.9,
        tree_scale=1.1,
        avenues=0.3,
        lamps=0.88,
        lamp_spacing_m=28.0,
        passages=0.6,
        patches_per_100m=5.5,
        signs=0.66,
        lights=0.05,
        objects_per_plot=2.2,
        bicycles_per_plot=0.5,
        people_per_100m=0.7,
        trucks=0.008,
    ),
}


@dataclass(frozen=True)
class Variation:
    """Random factors of a block, with mean 1."""

    room: float
    shrubs: float
    bushes: float
    trees: float
    tree_size: float
    walls: float
    cars: float
    furniture: float
    objects: float
    bicycles: float
    people: float


def draw_variation(rng: np.random.Generator) -> Variation:
    """Sample the variation of a block. Gamma distributions make counts vary more than those of a Poisson process."""

    def gamma(shape: float) -> float:
        return float(rng.gamma(shape) / shape)

    green = gamma(14)
    return Variation(
        room=float(np.exp(rng.normal(0, 0.12))),
        shrubs=green * gamma(20),
        bushes=green * gamma(20),
        trees=gamma(12),
        tree_size=float(np.exp(rng.normal(0, 0.14))),
        walls=gamma(7),
        cars=gamma(5),
        furniture=gamma(8),
        objects=gamma(3),
        bicycles=gamma(1.5) * green**2,
        people=gamma(1.5) * green,
    )
