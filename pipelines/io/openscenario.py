"""Export a Scene with its traffic as ASAM OpenSCENARIO XML 1.2, next to its roads as OpenDRIVE.

Coordinates are in the inertial frame of the OpenDRIVE file, which is the scene frame. The reference point of a vehicle
is the middle of its rear axle on the ground. The reference point of any other entity is the middle of its base. The
package scenariogeneration (extra `openscenario`) writes the elements.
"""

from __future__ import annotations

import datetime
import xml.etree.ElementTree as ET
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from models.scene import CATEGORIES, Scene, make_yaw_rotation
from pipelines.geometry.parked_vehicles import find_driving_vehicles
from pipelines.schema.file_names import clean_xml_text
from pipelines.schema.tracks import RoadUser, find_time_step, list_road_users

MINOR_VERSION = 2
DATE = datetime.datetime(2000, 1, 1)  # A fixed date in the header keeps files of equal scenes equal.
REAR_AXLE, FRONT_AXLE = -0.3, 0.3  # Positions of the axles relative to the centre, as shares of the length.
WHEEL_M, MAX_STEERING_RAD, MAX_SPEED_MPS, MAX_ACCELERATION_MPS2 = 0.7, 0.6, 70.0, 10.0


class EntityKind(NamedTuple):
    """How a category appears in OpenSCENARIO.

    Attributes:
        entity: Vehicle, Pedestrian or MiscObject.
        category: Category of the entity in OpenSCENARIO.
        density_kgpm3: Mass per volume of the box (kg/m³).
    """

    entity: str
    category: str
    density_kgpm3: float


KINDS = {
    "vegetation_cuboid": EntityKind("MiscObject", "vegetation", 10.0),
    "vegetation_ellipsoid": EntityKind("MiscObject", "vegetation", 10.0),
    "vehicle_big": EntityKind("Vehicle", "truck", 150.0),
    "vehicle_small": EntityKind("Vehicle", "car", 120.0),
    "two_wheelers": EntityKind("Vehicle", "bicycle", 50.0),
    "human": EntityKind("Pedestrian", "pedestrian", 120.0),
    "construction_big": EntityKind("MiscObject", "building", 300.0),
    "construction_small": EntityKind("MiscObject", "barrier", 500.0),
    "pole": EntityKind("MiscObject", "pole", 500.0),
    "traffic_control": EntityKind("MiscObject", "obstacle", 100.0),
    "object": EntityKind("MiscObject", "obstacle", 100.0),
}


def export_openscenario(scene: Scene, tracks: pa.Table, roads: str) -> bytes:
    """Export a scene and its traffic as an OpenSCENARIO file.

    The primitives of the scene are entities that stand still, except vehicles in traffic, which the simulated traffic
    replaces. Each road user appears at its first time, follows its trajectory and disappears after its last time.

    Args:
        scene: Scene.
        tracks: Rows of the table tracks of the scene.
        roads: Path of the OpenDRIVE file of the scene, relative to the OpenSCENARIO file.

    Returns:
        Content of the .xosc file.

    Raises:
        ValueError: The scene has no traffic, or the package scenariogeneration is missing.
    """
    try:
        xosc: Any = import_module("scenariogeneration.xosc")
    except ImportError as error:
        raise ValueError(
            "OpenSCENARIO needs the extra openscenario: pip install 'pritti-on-ray[openscenario]'"
        ) from error
    users = list_road_users(tracks)
    if not users:
        raise ValueError(f"scene {scene.scene_id} has no traffic to export")
    # The package keeps the version of all elements in one place.
    xosc.VersionBase().setVersion(minor=MINOR_VERSION)
    entities, init = xosc.Entities(), xosc.Init()
    lift_m = np.array([0.0, 0.0, _measure_lift(scene, users)])
    for index in np.flatnonzero(~find_driving_vehicles(scene)).tolist():
        category = CATEGORIES[scene.category[index]]
        name = f"{category}_{index:05d}"
        rotation = _turn_ahead(scene, index)
        entities.add_scenario_object(name, _make_entity(xosc, category, scene.size_m[index]))
        place_m = _find_reference(category, scene.size_m[index], scene.center_m[index], rotation) + lift_m
        angles_rad = Rotation.from_matrix(rotation).as_euler("ZYX")
        init.add_init_action(name, xosc.TeleportAction(_make_position(xosc, place_m, *angles_rad)))
    act = xosc.Act("traffic", _make_time_trigger(xosc, "start of traffic", 0.0))
    step_s = find_time_step(users)
    for user in users:
        user = user._replace(center_m=user.center_m + lift_m)
        name = user.name
        entities.add_scenario_object(name, _make_entity(xosc, user.category, user.size_m))
        act.add_maneuver_group(_make_maneuver_group(xosc, name, user, float(user.time_s[-1]) + step_s))
    end_s = max(float(user.time_s[-1]) for user in users) + 2 * step_s
    storyboard = xosc.StoryBoard(init, _make_time_trigger(xosc, "end of traffic", end_s, "stop"))
    storyboard.add_act(act)
    scenario = xosc.Scenario(
        f"Scene {scene.scene_id}",
        "PrITTI on Ray",
        xosc.ParameterDeclarations(),
        entities,
        storyboard,
        xosc.RoadNetwork(roads),
        xosc.Catalog(),
        osc_minor_version=MINOR_VERSION,
        license=xosc.License(scene.attribution) if scene.attribution else None,
        creation_date=DATE,
    )
    root = scenario.get_element()
    for element in root.iter():
        for key, value in element.attrib.items():
            element.set(key, clean_xml_text(str(value)))
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)


def _measure_lift(scene: Scene, users: list[RoadUser]) -> float:
    """Return the median height of the ground, and thus of the OpenDRIVE roads, above the base of road users (m).

    In sources such as KITTI-360, objects stand below the ground heights.
    """
    center_m = np.concatenate([user.center_m for user in users])
    base_m = np.concatenate([user.center_m[:, 2] - user.size_m[2] / 2 for user in users])
    height_m, classes = scene.surface()
    row, col = scene.grid.pixel(center_m[:, 0], center_m[:, 1])
    inside = (row >= 0) & (col >= 0) & (row < scene.grid.rows) & (col < scene.grid.cols)
    row, col, base_m = row[inside], col[inside], base_m[inside]
    known = classes[row, col] >= 0
    return float(np.median(height_m[row, col][known] - base_m[known])) if known.any() else 0.0


def _turn_ahead(scene: Scene, index: int) -> np.ndarray:
    """Return the rotation (3, 3) of a primitive, with its length axis ahead rather than back.

    The heading of some objects, such as signs of Argoverse 2, is across their length. Their length axis is kept.
    """
    rotation = scene.rotation[index].astype(float)
    heading_rad = float(scene.heading_rad[index])
    if np.isfinite(heading_rad) and np.cos(heading_rad - float(scene.yaw_rad[index])) < -1e-6:
        return rotation * [-1.0, -1.0, 1.0]
    return rotation


def _find_reference(category: str, size_m: np.ndarray, center_m: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the reference points (..., 3) of an entity from its centres (..., 3) and rotations (..., 3, 3)."""
    length_m, _, height_m = (float(value) for value in size_m)
    ahead_m = -REAR_AXLE * length_m if KINDS[category].entity == "Vehicle" else 0.0
    return np.asarray(center_m, float) - rotation @ np.array([ahead_m, 0.0, height_m / 2])


def _make_position(xosc: Any, place_m: np.ndarray, heading_rad: float, pitch_rad: float, roll_rad: float) -> Any:
    x, y, z = (round(float(value), 4) for value in place_m)
    return xosc.WorldPosition(x, y, z, *(round(float(angle), 5) for angle in (heading_rad, pitch_rad, roll_rad)))


def _make_entity(xosc: Any, category: str, size_m: np.ndarray) -> Any:
    kind = KINDS[category]
    length_m, width_m, height_m = (round(float(value), 3) for value in size_m)
    mass_kg = round(kind.density_kgpm3 * length_m * width_m * height_m, 1)
    if kind.entity == "Vehicle":
        wheelbase_m = round((FRONT_AXLE - REAR_AXLE) * length_m, 3)
        box = xosc.BoundingBox(width_m, length_m, height_m, wheelbase_m / 2, 0, height_m / 2)
        wheel_m = min(WHEEL_M, height_m)
        front = xosc.Axle(MAX_STEERING_RAD, wheel_m, width_m, wheelbase_m, wheel_m / 2)
        rear = xosc.Axle(0, wheel_m, width_m, 0, wheel_m / 2)
        limits = MAX_SPEED_MPS, MAX_ACCELERATION_MPS2, MAX_ACCELERATION_MPS2
        form = getattr(xosc.VehicleCategory, kind.category)
        return xosc.Vehicle(category, form, box, front, rear, *limits, mass_kg)
    box = xosc.BoundingBox(width_m, length_m, height_m, 0, 0, height_m / 2)
    if kind.entity == "Pedestrian":
        return xosc.Pedestrian(category, mass_kg, xosc.PedestrianCategory.pedestrian, box)
    return xosc.MiscObject(category, mass_kg, getattr(xosc.MiscObjectCategory, kind.category), box)


def _make_time_trigger(xosc: Any, name: str, time_s: float, point: str = "start") -> Any:
    condition = xosc.SimulationTimeCondition(round(time_s, 4), xosc.Rule.greaterOrEqual)
    return xosc.ValueTrigger(name, 0, xosc.ConditionEdge.none, condition, triggeringpoint=point)


def _make_maneuver_group(xosc: Any, name: str, user: RoadUser, end_s: float) -> Any:
    """Return the maneuver group in which a road user appears, follows its trajectory and disappears."""
    places_m = _find_reference(user.category, user.size_m, user.center_m, make_yaw_rotation(user.yaw_rad.astype(float)))
    headings_rad = np.unwrap(user.yaw_rad)
    positions = [_make_position(xosc, place, yaw, 0, 0) for place, yaw in zip(places_m, headings_rad, strict=True)]
    maneuver = xosc.Maneuver(f"drive of {name}")

    def add_event(what: str, time_s: float, *actions: Any) -> None:
        event = xosc.Event(f"{name} {what}", xosc.Priority.parallel)
        for number, action in enumerate(actions):
            event.add_action(f"{name} {what} {number}", action)
        event.add_trigger(_make_time_trigger(xosc, f"time of {name} {what}", time_s))
        maneuver.add_event(event)

    start_s = float(user.time_s[0])
    add_event("appears", start_s, xosc.AddEntityAction(name, positions[0]))
    if len(positions) > 1:
        trajectory = xosc.Trajectory(f"trajectory of {name}", False)
        trajectory.add_shape(xosc.Polyline([round(float(t), 4) for t in user.time_s], positions))
        mode, domain = xosc.FollowingMode.position, xosc.ReferenceContext.absolute
        add_event("drives", start_s, xosc.FollowTrajectoryAction(trajectory, mode, domain, 1, 0))
    add_event("leaves", end_s, xosc.DeleteEntityAction(name))
    group = xosc.ManeuverGroup(f"group of {name}")
    group.add_actor(name)
    group.add_maneuver(maneuver)
    return group
