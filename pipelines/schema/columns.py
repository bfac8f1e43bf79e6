"""Columns of the Parquet tables; real and generated scenes share this schema.

Column names contain units. The metadata of every file describes the columns. docs/reference/tables.md documents the
tables for users.
"""

from __future__ import annotations

import json

import pyarrow as pa

from models.scene import CATEGORIES, GROUND_CLASSES
from models.voxel_grids import COARSE_FACTORS, NUM_CLASSES, name_voxel_column
from pipelines.runtime import storage

TABLES = ("scenes", "primitives", "rasters", "edits", "rejects")
TRAFFIC_TABLES = ("tracks", "traffic")  # Tables of jobs/simulate_traffic.py.
SCENE_TABLES = ("scenes", "primitives", "rasters")  # Tables that every shard has.
TEXTS = ("scene_id", "category", "label", "kind")  # Text columns of the table `primitives`.
SCHEMA_VERSION = "1"  # Version of the column names and types. Descriptions may change within a version.
DEFAULTS = {"free_pose": "false", "attribution": "null"}  # JSON value of columns that earlier versions did not write.
HEIGHT_STEP_M = 0.01
MAX_HEIGHT_M = 32767 * HEIGHT_STEP_M  # Largest height (m) that a 16-bit integer can store.

# Meanings of the categories and ground classes, used in the descriptions of columns.
# fmt: off
CATEGORY_MEANING = {
    "vegetation_cuboid":    "trees, bushes and hedges annotated as boxes",
    "vegetation_ellipsoid": "trees and bushes annotated as ellipsoids",
    "vehicle_big":          "trucks, buses and trams",
    "vehicle_small":        "cars and trailers",
    "two_wheelers":         "bicycles and motorcycles",
    "human":                "pedestrians and riders",
    "construction_big":     "buildings and garages",
    "construction_small":   "walls, fences, guard rails and gates",
    "pole":                 "poles and bollards",
    "traffic_control":      "traffic lights, traffic signs and street lamps",
    "object":               "bins, boxes, cones and other small objects",
}
GROUND_MEANING = {
    "road":     "carriageway, or drivable area (av2)",
    "sidewalk": "sidewalks",
    "parking":  "parking areas and driveways",
    "terrain":  "grass, soil and similar surfaces",
    "ground":   "ground of any other kind",
    "crossing": "pedestrian crossings on the road",
}
# fmt: on


def _make_schema(description: str, *columns: tuple[str, pa.DataType, str, str]) -> pa.Schema:
    """Make a self-describing schema from rows of (name, type, unit, description); the unit "" means dimensionless.

    Every field has the metadata `unit` and `description`. DuckDB does not show field metadata. The metadata of the
    table therefore repeats the rows as JSON under `pritti_columns`. DEFAULTS gives the value of columns that earlier
    versions did not write.
    """
    fields, rows = [], []
    for name, kind, unit, meaning in columns:
        about = {"description": meaning} | ({"unit": unit} if unit else {})
        if name in DEFAULTS:
            about[storage.DEFAULT.decode()] = DEFAULTS[name]
        fields.append(pa.field(name, kind, metadata=about))
        rows.append({"name": name, "unit": unit or None, "description": meaning})
    metadata = {
        "pritti_schema_version": SCHEMA_VERSION,
        "pritti_description": description,
        "pritti_columns": json.dumps(rows, ensure_ascii=False),
    }
    return pa.schema(fields, metadata)


# fmt: off
_FRAME = (
    "Scene frame: origin at the ego vehicle, x forward, y left, z up along gravity. Angles are "
    "counter-clockwise from x, seen from above."
)
_SCENE_ID = ("scene_id", pa.string(), "", "Name of the scene, unique within a dataset directory; key of all tables.")
_SEQUENCE = ("sequence", pa.string(), "",
             "Drive of the scene: KITTI-360 drive, Argoverse 2 log, town or own folder; for sampled scenes, the "
             "seed.")

SCENES = _make_schema(
    "One row per scene: labels and totals of a crop of the world ahead of one ego pose (64 x 64 m unless "
    "extended). " + _FRAME,
    _SCENE_ID,
    _SEQUENCE,
    ("frame",                pa.int64(),   "1; av2: ns",
     "Frame number (av2: timestamp), ascending along the drive; for generated scenes, the index within the run."),
    ("x_m",                  pa.float64(), "m",
     "x of the scene's origin in the world frame. kitti360 has one world frame, av2 has one per city, and other "
     "sources have one per sequence."),
    ("y_m",                  pa.float64(), "m",
     "y of the scene's origin in the world frame; the origin of a sampled scene is (0, 0, 0)."),
    ("z_m",                  pa.float64(), "m",
     "z (up) of the scene's origin in the world frame. This is the height of the vehicle's origin, not of the road."),
    ("yaw_rad",              pa.float64(), "rad",
     "Angle from the world's x axis to the scene's x axis, in [-pi, pi]."),
    # A list of variable size, because Parquet has no null value for a list of fixed size.
    ("world_from_imu",       pa.list_(pa.float64()), "1; m",
     "Full pose in the source dataset, a 3 x 4 matrix row by row with the translation (m) in its last column; or "
     "null."),
    ("free_pose",            pa.bool_(),   "",
     "Whether the scene is a crop at any place and heading (town of version 2, osm); false for the view of a vehicle "
     "and in files of earlier versions."),
    ("attribution",          pa.string(),  "",
     "Licence notice that copies of the scene must state, such as that of OpenStreetMap; null if there is none."),
    ("vegetation_density",   pa.string(),  "",
     "low, medium or high, by number and volume of vegetation; for generated scenes, the requested label or null."),
    ("vehicle_density",      pa.string(),  "",
     "low, medium or high, by number and volume of big and small vehicles; for generated scenes, the requested label "
     "or null."),
    ("vegetation_volume_m3", pa.float64(), "m3",
     "Sum of the volumes of all vegetation primitives; overlapping volume counts once per primitive."),
    ("vehicle_volume_m3",    pa.float64(), "m3",  "Sum of the volumes of all big and small vehicles."),
    ("num_primitives",       pa.int32(),   "1",   "Number of primitives of all categories."),
    *[(f"num_{name}",        pa.int32(),   "1",
       f"Number of {name} primitives: {CATEGORY_MEANING[name]}.")
      for name in CATEGORIES],
    *[(f"{name}_area_m2",    pa.float64(), "m2",
       f"Area of {name} seen from above: {GROUND_MEANING[name]}; null if the scene's source lacks this class.")
      for name in GROUND_CLASSES],
    ("primitive_offset",     pa.int64(),   "1",
     "Row (from 0) of the scene's first primitive in the primitives file of the same part."),
)

PRIMITIVES = _make_schema(
    "One row per primitive and scene: a cuboid or ellipsoid whose centre lies in the scene. An object that "
    "several scenes contain has one row per scene. " + _FRAME,
    _SCENE_ID,
    ("category",    pa.string(),  "",    "One of the eleven categories that all sources share."),
    ("label",       pa.string(),  "",
     "Class name in the source dataset; for generated primitives, the category."),
    ("kind",        pa.string(),  "",    "Shape within the bounding box: cuboid or ellipsoid."),
    ("instance_id", pa.int64(),   "",
     "Number of the object in its sequence, or -1; kitti360 and town number static and moving objects separately."),
    ("x_m",         pa.float32(), "m",   "x of the centre in the scene frame: distance ahead of the ego vehicle."),
    ("y_m",         pa.float32(), "m",
     "y of the centre in the scene frame: distance to the left of the ego vehicle."),
    ("z_m",         pa.float32(), "m",
     "z of the centre in the scene frame: height above the scene's origin, not above the ground."),
    ("length_m",    pa.float32(), "m",   "Full extent along the longer of the two axes other than the height axis."),
    ("width_m",     pa.float32(), "m",   "Full extent along the shorter of the two axes other than the height axis."),
    ("height_m",    pa.float32(), "m",   "Full extent along the height axis, the axis closest to vertical."),
    ("yaw_rad",     pa.float32(), "rad", "Direction of the length axis in the scene frame, in [-pi/2, pi/2)."),
    ("heading_rad", pa.float32(), "rad",
     "Direction of travel in the scene frame, in [-pi, pi); null if unknown and for all generated primitives."),
    ("rotation",    pa.list_(pa.float32(), 9), "1",
     "Rotation matrix R, row by row; its columns are the length, width and height axes in the scene frame."),
    ("cholesky",    pa.list_(pa.float32(), 6), "m^0.5",
     "Cholesky factor of the scatter matrix R diag(length, width, height) R^T: the lower triangle, row by row."),
    ("existence",   pa.float32(), "1",
     "Existence probability in [0, 1]; 1 for annotated primitives."),
)

RASTERS = _make_schema(
    "One row per scene: mask and height of each ground class, as rasters [class, row, col] seen from above. " + _FRAME,
    _SCENE_ID,
    ("height",         pa.binary(),  "height_step_m",
     "z of the ground at each set bit of `occupied`: little-endian int16, stored as differences of successive values."),
    ("occupied",       pa.binary(),  "",
     "One bit per (class, row, col) in C order, most significant first; 1 if the class covers the pixel's centre."),
    ("resolution_m",   pa.float64(), "m",   "Edge length of a pixel."),
    ("height_step_m",  pa.float64(), "m",   "Height that one unit of `height` represents."),
    ("rows",           pa.int32(),   "1",   "Number of pixel rows; row 0 is the farthest ahead."),
    ("cols",           pa.int32(),   "1",   "Number of pixel columns; column 0 is the leftmost."),
    ("front_m",        pa.float64(), "m",
     "x of the far edge in the scene frame; pixel centres lie at x = front_m - (row + 0.5) resolution_m."),
    ("left_m",         pa.float64(), "m",
     "y of the left edge in the scene frame; pixel centres lie at y = left_m - (col + 0.5) resolution_m."),
    ("ground_classes", pa.list_(pa.string()), "", "Names of the ground classes, in the order of the first axis."),
)

REJECTS = _make_schema(
    "One row per reject: a scene that preprocessing excluded, or a drive that preprocessing could not read.",
    ("scene_id", pa.string(), "", "Name of the rejected scene; if frame is null, name of the rejected drive."),
    _SEQUENCE,
    ("frame",    pa.int64(),  "1; av2: ns", "Frame number (av2: timestamp); null if the whole drive is rejected."),
    ("reason",   pa.string(), "", "Reason for the reject."),
)


EDITS = _make_schema(
    "One row per primitive that an edit step changed. The scene_id is the same in the input and the edited "
    "dataset.",
    _SCENE_ID,
    ("step",       pa.int32(),   "1",   "Number of the edit step, from 0; edited-<run>.json lists the steps."),
    ("edit",       pa.string(),  "",    "remove, duplicate, translate, rotate, scale, relabel, snap or repair."),
    ("primitive",  pa.int32(),   "1",   "Number (from 0) of the primitive in the scene before this step."),
    ("change",     pa.string(),  "",    "Effect on the primitive: removed, copied or changed."),
    ("moved_m",    pa.float32(), "m",   "Displacement of the centre; for a copy, the distance from its original."),
    ("turned_rad", pa.float32(), "rad", "Largest angle by which an axis turned; opposite directions count as equal."),
    ("resized",    pa.float32(), "1",   "Largest relative change of length, width or height."),
)


TRACKS = _make_schema(
    "One row per road user and time of simulated traffic (jobs/simulate_traffic.py), ordered by scene, road user and "
    "time. " + _FRAME,
    _SCENE_ID,
    ("object_id", pa.int32(),   "1",   "Number of the road user in the simulation of the scene, by time of departure."),
    ("category",  pa.string(),  "",    "vehicle_small, vehicle_big, two_wheelers or human."),
    ("time_s",    pa.float32(), "s",   "Time since the start of the simulation."),
    ("x_m",       pa.float32(), "m",   "x of the centre in the scene frame."),
    ("y_m",       pa.float32(), "m",   "y of the centre in the scene frame."),
    ("z_m",       pa.float32(), "m",   "z of the centre in the scene frame."),
    ("yaw_rad",   pa.float32(), "rad", "Direction of travel in the scene frame, in [-pi, pi)."),
    ("speed_mps", pa.float32(), "m/s", "Speed."),
    ("length_m",  pa.float32(), "m",   "Length of the road user."),
    ("width_m",   pa.float32(), "m",   "Width of the road user."),
    ("height_m",  pa.float32(), "m",   "Height of the road user."),
)

TRAFFIC = _make_schema(
    "One row per scene, and one per damaged copy of a scene: what happened to the simulated vehicles.",
    _SCENE_ID,
    ("control",   pa.bool_(),   "",
     "true for the copy of the scene with closed roads, which has no rows in tracks; false for the scene."),
    ("failure",   pa.string(),  "",
     "Reason why there is no simulation, such as a scene without roads or without a route; all later columns are then "
     "null. null after a simulation."),
    ("roads",             pa.int32(), "1", "Number of edges of the network: directions of roads between junctions."),
    ("one_way_roads",     pa.int32(), "1",
     "Number of roads that are too narrow for two directions and have lost one."),
    ("unreachable_roads", pa.int32(), "1",
     "Number of edges on which no vehicle can drive from one border of the scene to another."),
    ("network_warnings",  pa.int32(), "1", "Number of warnings of SUMO's netconvert."),
    ("requested",         pa.int32(), "1", "Number of random pairs of an entry and an exit of the scene."),
    ("routed",            pa.int32(), "1", "Number of these pairs with a route; each is a vehicle."),
    ("inserted",          pa.int32(), "1", "Number of vehicles in the simulation, with those that start inside."),
    ("arrived",           pa.int32(), "1", "Number of inserted vehicles that left the scene, without teleports."),
    ("teleports",         pa.int32(), "1", "Number of times that SUMO moved a vehicle out of a jam."),
    ("collisions",        pa.int32(), "1", "Number of collisions between vehicles."),
    ("pedestrian_collisions", pa.int32(), "1", "Number of collisions of vehicles and pedestrians."),
    ("parked",            pa.int32(), "1", "Number of parked vehicles, which are obstacles."),
    ("parked_contacts",   pa.int32(), "1", "Number of vehicles that overlapped a parked vehicle by more than 0.1 m."),
    ("fixed_contacts",    pa.int32(), "1",
     "Number of vehicles that overlapped a building, wall, pole or object by more than 0.1 m."),
    ("pedestrians",       pa.int32(), "1", "Number of pedestrians in the simulation."),
    ("mean_distance_m",   pa.float64(), "m",   "Mean route length of arrived vehicles."),
    ("mean_speed_mps",    pa.float64(), "m/s", "Mean speed of arrived vehicles."),
)


VOXELS = _make_schema(
    "One row per scene: class ids of semantic voxels [row, col, level], from jobs/voxelize_scenes.py or from a voxel "
    "model. Each grid is one zstd frame of unsigned bytes in C order. " + _FRAME,
    _SCENE_ID,
    ("rows",         pa.int32(),   "1", "Number of rows of the fine grid; row 0 is the farthest ahead."),
    ("cols",         pa.int32(),   "1", "Number of columns of the fine grid; column 0 is the leftmost."),
    ("levels",       pa.int32(),   "1", "Number of levels of the fine grid; level 0 is the lowest."),
    ("resolution_m", pa.float64(), "m", "Edge length of a fine voxel along x and y."),
    ("level_m",      pa.float64(), "m", "Height of a fine voxel."),
    ("front_m",      pa.float64(), "m", "x of the far side of the grid in the scene frame."),
    ("left_m",       pa.float64(), "m", "y of the left side of the grid in the scene frame."),
    ("bottom_m",     pa.float64(), "m", "z of the lower side of the grid in the scene frame."),
    ("num_voxels",   pa.list_(pa.int64(), NUM_CLASSES), "1",
     "Number of fine voxels of each class id: 0 empty, then the classes of docs/how_to/import_scenes.md."),
    ("voxels",       pa.binary(),  "", "Fine voxels: rows x cols x levels bytes after decompression."),
    *[(name_voxel_column(factor), pa.binary(), "",
       f"Voxels of {' x '.join(map(str, factor))} fine voxels: the most frequent class that is not empty, the lowest "
       "of equally frequent ones; null if not requested.")
      for factor in COARSE_FACTORS],
)


def make_latents_schema(shape: tuple[int, int, int]) -> pa.Schema:
    """Return the schema of the latents table, with the posterior mean and log variance per scene.

    Args:
        shape: (C, h, w) shape of one latent, channels first; values are float16.

    Returns:
        Schema with the columns scene_id, mean and logvar.
    """
    tensor = pa.fixed_shape_tensor(pa.float16(), shape)
    return _make_schema(
        "One row per scene: its latent from the layout VAE that latents.json names. Rows and columns have the "
        "order of the rasters.",
        _SCENE_ID,
        ("mean",   tensor, "1", "Mean of the latent's normal distribution: float16 (channel, row, col), C order."),
        ("logvar", tensor, "1", "Natural logarithm of the latent's variance: float16 (channel, row, col), C order."),
    )


def make_street_latents_schema(shape: tuple[int, int, int]) -> pa.Schema:
    """Return the schema of the table street_latents.

    Args:
        shape: (C, h, w) shape of the ground channels of one latent.

    Returns:
        Schema with the columns scene_id, ground and cells.
    """
    return _make_schema(
        "One row per scene: the latent of its streets without any other content, from the layout VAE that latents.json "
        "names. The ground around the streets is terrain.",
        _SCENE_ID,
        ("ground", pa.fixed_shape_tensor(pa.float16(), shape), "1",
         "Mean of the ground channels of the latent: float16 (channel, row, col), C order."),
        ("cells", pa.fixed_shape_tensor(pa.uint8(), shape[1:]), "",
         "1 for each latent cell (row, col) that lies completely on roads and sidewalks, else 0."),
    )


def make_street_maps_schema(shape: tuple[int, int, int]) -> pa.Schema:
    """Return the schema of the table street_maps.

    Args:
        shape: (C, h, w) shape of the distances of one map.

    Returns:
        Schema.
    """
    return _make_schema(
        "One row per crop of a town at any place and heading, as signed distances to the borders of its streets. "
        "Rows and columns have the order of the rasters; a pixel has a side of 4 m.",
        ("map_id",   pa.string(), "", "Name of the map."),
        _SEQUENCE,
        ("num_vegetation",       pa.int32(),   "1",  "Number of vegetation primitives in the crop."),
        ("vegetation_volume_m3", pa.float64(), "m3", "Sum of the volumes of these primitives."),
        ("num_vehicle",          pa.int32(),   "1",  "Number of big and small vehicles in the crop."),
        ("vehicle_volume_m3",    pa.float64(), "m3", "Sum of the volumes of these vehicles."),
        ("distance_m", pa.fixed_shape_tensor(pa.float16(), shape), "m",
         "Signed distances (channel, row, col) to the border of the roads, and to the border of roads and sidewalks "
         "taken together; positive inside, clipped to 8 m."),
    )
# fmt: on
