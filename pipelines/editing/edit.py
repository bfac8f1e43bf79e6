"""Edits of a scene's primitives: choose some, change their parameters exactly, keep the list of what was done.

A list of edits is data: the same list replayed on the same scene gives the same scene, bit for bit, and it can be
replayed on any other. As JSON it is a list of objects such as

    {"edit": "translate", "select": {"category": ["vehicle_small"], "where": "length_m > 4"}, "by_m": [5, 0, 0]}
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Literal, NamedTuple

import duckdb
import numpy as np
import pyarrow as pa
from pydantic import ConfigDict, TypeAdapter, ValidationError

from models.composition.inpaint import contains_points
from models.scene import (
    CATEGORIES,
    CATEGORY_INDEX,
    Scene,
    canonicalize_boxes,
    concatenate_primitives,
    make_yaw_rotation,
)
from pipelines.editing.repair import GroundFaults, find_removable_objects, separate_objects, snap_to_ground
from pipelines.metrics.validity import SLAB_OFFSET_M
from pipelines.schema.tables import PRIMITIVES, make_primitives_table

SIZES_M = (1e-3, 1e3)  # what an edit may leave


@dataclass(frozen=True)
class Select:
    """Primitives of a scene: those that fit everything that is named."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    category: tuple[str, ...] = ()
    """Of one of these categories."""
    primitives: tuple[int, ...] = ()
    """By number, as in the scene's rows of the primitives table, from 0."""
    instances: tuple[int, ...] = ()
    """By instance_id."""
    polygon_m: tuple[float, ...] = ()
    """Centre inside a polygon: x y of its corners in metres, x ahead, y left."""
    where: str = ""
    """A condition in SQL on columns of the primitives table, such as "length_m > 4 and y_m < 0"; "true" for all."""

    def check(self) -> None:
        """Raises ValueError for what no scene can answer: nothing named, no such category, a condition that is none."""
        self._check_names()
        if self.where:
            _evaluate_where(PRIMITIVES.empty_table(), self.where)

    def _check_names(self) -> None:
        if self == Select():
            raise ValueError("no primitives are chosen: give category, primitives, instances, polygon-m or where")
        for name in self.category:
            _parse_category(name)
        if len(self.polygon_m) % 2:
            raise ValueError(f"a polygon of {len(self.polygon_m)} numbers: expected x y x y ... in metres")

    def select_primitives(self, scene: Scene) -> np.ndarray:
        """(n,) bool. Raises ValueError as `check` does, or for primitives the scene does not have."""
        self._check_names()
        fits = np.ones(len(scene), bool)
        if self.category:
            fits &= np.isin(scene.category, [_parse_category(name) for name in self.category])
        if self.primitives:
            numbers = ", ".join(map(str, self.primitives))
            if not -1 < min(self.primitives) <= max(self.primitives) < len(scene):
                raise ValueError(f"scene {scene.scene_id} has {len(scene)} primitives, from 0 on, not {numbers}")
            fits &= np.isin(np.arange(len(scene)), self.primitives)
        if self.instances:
            fits &= np.isin(scene.instance_id, self.instances)
        if self.polygon_m:
            fits &= contains_points(np.reshape(self.polygon_m, (-1, 2)), *scene.center_m[:, :2].T)
        if self.where:
            fits &= _evaluate_where(make_primitives_table([scene]), self.where)
        return fits


def _evaluate_where(table: pa.Table, condition: str) -> np.ndarray:
    """(n,) bool: rows of a primitives table that a condition in SQL holds for."""
    table = table.append_column("row", pa.array(np.arange(len(table))))
    with duckdb.connect(config={"enable_external_access": False}) as connection:
        try:
            rows = connection.from_arrow(table).filter(condition).project("row").fetchnumpy()["row"]
        except duckdb.Error as error:
            first = str(error).splitlines()[0]
            raise ValueError(
                f"where {condition!r}: {first}; docs/tables.md names the columns, text stands in 'single quotes'"
            ) from error
    return np.isin(np.arange(len(table)), rows)


@dataclass(frozen=True)
class Edit(ABC):
    """One change of the primitives that `select` names."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    select: Select = field(default_factory=Select)

    @property
    def name(self) -> str:
        return type(self).__name__.lower()

    def check(self) -> None:
        """Raises ValueError for an edit that no scene can take, or that changes none."""
        self.select.check()

    @abstractmethod
    def apply_to(self, scene: Scene, chosen: np.ndarray) -> tuple[Scene, np.ndarray]:
        """Return the scene with its chosen (n,) primitives changed, and the previous number (m,) of each primitive.

        Raises ValueError for a broken result.
        """


class ObjectEdit(Edit):
    """An edit after which every primitive is still there, in its place of the list."""

    @abstractmethod
    def transform(self, part: Scene) -> Scene:
        """A scene of the chosen primitives only -> what they become. Its ground is the whole scene's."""

    def apply_to(self, scene: Scene, chosen: np.ndarray) -> tuple[Scene, np.ndarray]:
        part = require_valid_objects(self.transform(scene.select(chosen)))
        place = np.arange(len(scene))
        place[chosen] = len(scene) + np.arange(len(part))
        return replace(scene, **concatenate_primitives([scene, part])).select(place), np.arange(len(scene))


def require_valid_objects(part: Scene) -> Scene:
    """The same scene. Raises ValueError if a primitive is nowhere, or no size for a thing."""
    size_m = part.size_m
    if not (np.isfinite(part.center_m).all() and ((size_m >= SIZES_M[0]) & (size_m <= SIZES_M[1])).all()):
        raise ValueError(f"a primitive of scene {part.scene_id} would be thinner than 1 mm, beyond 1 km or nowhere")
    return part


@dataclass(frozen=True)
class Remove(Edit):
    """Take primitives out."""

    def apply_to(self, scene: Scene, chosen: np.ndarray) -> tuple[Scene, np.ndarray]:
        return scene.select(~chosen), np.flatnonzero(~chosen)


@dataclass(frozen=True)
class Duplicate(Edit):
    """Put copies at the end of the list, moved along the scene's axes; a copy has no instance_id."""

    by_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x (ahead), y (left), z (up) in metres."""

    def check(self) -> None:
        super().check()
        _check_way(self.by_m)

    def apply_to(self, scene: Scene, chosen: np.ndarray) -> tuple[Scene, np.ndarray]:
        copies = require_valid_objects(Translate(by_m=self.by_m).transform(scene.select(chosen)))
        copies = replace(copies, instance_id=np.full(len(copies), -1, np.int64))
        return replace(scene, **concatenate_primitives([scene, copies])), np.append(
            np.arange(len(scene)), np.flatnonzero(chosen)
        )


@dataclass(frozen=True)
class Translate(ObjectEdit):
    """Move."""

    by_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """x (ahead), y (left), z (up) in metres."""
    along: Literal["scene", "own"] = "scene"
    """Along the scene's axes, or each primitive's own: length (the way it heads, if known), width, height."""

    def check(self) -> None:
        super().check()
        _check_way(self.by_m)

    def transform(self, part: Scene) -> Scene:
        way_m = np.broadcast_to(np.array(self.by_m, float), (len(part), 3))
        if self.along == "own":
            ahead = np.stack([np.cos(part.heading_rad), np.sin(part.heading_rad), np.zeros(len(part))], axis=1)
            backward = (part.rotation[:, :, 0] * ahead).sum(axis=1) < 0  # NaN, an unknown heading, is not
            turned = part.rotation * np.where(backward[:, None], [-1, -1, 1], 1)[:, None, :]
            way_m = (turned @ way_m[:, :, None])[:, :, 0]
        return replace(part, center_m=(part.center_m + way_m).astype(np.float32))


@dataclass(frozen=True)
class Rotate(ObjectEdit):
    """Turn about the vertical, counter-clockwise seen from above."""

    by_deg: float = 0.0
    about_m: tuple[float, float] | None = None
    """x and y of the axis (default: each primitive's own centre)."""

    def check(self) -> None:
        super().check()
        if not np.isfinite(self.by_deg) or self.by_deg % 360 == 0:
            raise ValueError(f"rotate by {self.by_deg} degrees turns nothing")

    def transform(self, part: Scene) -> Scene:
        by_rad = np.deg2rad(self.by_deg)
        turn = make_yaw_rotation(by_rad)
        rotation, size_m = canonicalize_boxes(turn @ part.rotation.astype(float), part.size_m)
        center_m = part.center_m
        if self.about_m is not None:
            axis_m = np.array([*self.about_m, 0.0])
            center_m = (axis_m + (center_m - axis_m) @ turn.T).astype(np.float32)
        heading = (part.heading_rad + by_rad + np.pi) % (2 * np.pi) - np.pi
        return replace(
            part,
            rotation=rotation.astype(np.float32),
            size_m=size_m,
            center_m=center_m,
            heading_rad=heading.astype(np.float32),
        )


@dataclass(frozen=True)
class Scale(ObjectEdit):
    """Make larger or smaller along a primitive's own axes."""

    by: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors of length, width and height."""
    hold: Literal["bottom", "centre"] = "bottom"
    """What stays where it is."""

    def check(self) -> None:
        super().check()
        if not all(np.isfinite(self.by)) or min(self.by) <= 0 or set(self.by) == {1}:
            raise ValueError(f"scale by {list(self.by)}: expected factors above 0, not all of them 1")

    def transform(self, part: Scene) -> Scene:
        rotation, size_m = canonicalize_boxes(part.rotation, part.size_m * np.array(self.by, np.float32))
        part_scaled = replace(part, rotation=rotation, size_m=size_m)
        if self.hold == "centre":
            return part_scaled
        up_m = part.bottom_m - part_scaled.bottom_m
        return replace(part_scaled, center_m=_raise_objects(part, up_m))


@dataclass(frozen=True)
class Relabel(ObjectEdit):
    """Give another category; vegetation_ellipsoid makes ellipsoids, every other cuboids."""

    category: str = "object"
    label: str | None = None
    """The dataset's own class name (default: the category's)."""

    def check(self) -> None:
        super().check()
        _parse_category(self.category)

    def transform(self, part: Scene) -> Scene:
        index, label = _parse_category(self.category), self.label or self.category
        return replace(part, category=np.full_like(part.category, index), label=np.full(len(part), label, object))


@dataclass(frozen=True)
class Snap(ObjectEdit):
    """Put the lowest point on the ground under the centre; what is over no known ground stays."""

    slab_offset_m: float = SLAB_OFFSET_M
    """How far the ground's heights lie above the surface: 0.3 in KITTI-360 and the town, 0 in Argoverse 2."""

    def transform(self, part: Scene) -> Scene:
        height_m, _ = part.ground_under()
        above_m = part.bottom_m - (height_m - self.slab_offset_m)
        return replace(part, center_m=_raise_objects(part, -np.nan_to_num(above_m)))


@dataclass(frozen=True)
class Repair(Edit):
    """Mend faults (metrics/validity.py) by as little as it takes: onto the ground, apart, else out."""

    slab_offset_m: float = SLAB_OFFSET_M
    """As for snap."""
    ground: GroundFaults = "both"
    """What to put on the ground."""
    push_m: float = 0.25
    """How far overlapping things may be pushed, each."""
    shrink: float = 0.95
    """To what share of its size a thing may shrink where pushing is not enough."""
    drop: bool = True
    """Take out one of two that overlap all the same."""

    def check(self) -> None:
        super().check()
        if not 0 <= self.push_m < np.inf:
            raise ValueError(f"push_m is {self.push_m}, expected metres, 0 or more")
        if not 0 < self.shrink <= 1:
            raise ValueError(f"shrink is {self.shrink}, expected a share of the size above 0, at most 1 (no shrinking)")

    def apply_to(self, scene: Scene, chosen: np.ndarray) -> tuple[Scene, np.ndarray]:
        scene = snap_to_ground(scene, chosen, self.slab_offset_m, self.ground)
        scene = require_valid_objects(separate_objects(scene, chosen, self.push_m, self.shrink))
        scene = snap_to_ground(scene, chosen, self.slab_offset_m, self.ground)  # where a push led over a slope
        gone = find_removable_objects(scene, chosen) if self.drop else np.zeros(len(scene), bool)
        return scene.select(~gone), np.flatnonzero(~gone)


EDITS = {kind.__name__.lower(): kind for kind in (Remove, Duplicate, Translate, Rotate, Scale, Relabel, Snap, Repair)}


def _raise_objects(part: Scene, up_m: np.ndarray) -> np.ndarray:
    """(n, 3) centres moved up by up_m (n,)."""
    return (part.center_m + up_m[:, None] * np.array([0.0, 0.0, 1.0])).astype(np.float32)


def _check_way(by_m: Sequence[float]) -> None:
    if not np.isfinite(by_m).all() or not any(by_m):
        raise ValueError(f"by_m is {list(by_m)}: expected metres along x, y and z, not all 0")


def _parse_category(name: str) -> int:
    if name not in CATEGORY_INDEX:
        raise ValueError(f"category {name!r} is unknown, expected one of: {', '.join(CATEGORIES)}")
    return CATEGORY_INDEX[name]


class ObjectChange(NamedTuple):
    """What an edit did, a row per primitive it touched; numbers are those before it."""

    primitive: np.ndarray  # (k,) int, index into the scene before
    change: np.ndarray  # (k,) str: removed, copied or changed
    moved_m: np.ndarray  # (k,) float64, of the centre; a copy's distance from its original
    turned_rad: np.ndarray  # (k,) float64, the most that one of its axes turned, as a line
    resized: np.ndarray  # (k,) float64, the largest change of an extent as a share of what it was


def compare_objects(before: Scene, after: Scene, origin: np.ndarray) -> ObjectChange:
    """What became of the primitives of a scene; origin (m,): the number that each of `after` had there."""
    removed = np.setdiff1d(np.arange(len(before)), origin)
    copied = np.ones(len(origin), bool)
    copied[np.unique(origin, return_index=True)[1]] = False
    was = before.select(origin)
    moved_m = np.linalg.norm(after.center_m.astype(float) - was.center_m, axis=1)
    along = np.abs((after.rotation.astype(float) * was.rotation).sum(axis=1)).min(axis=1, initial=1)
    turned_rad = np.where(np.all(after.rotation == was.rotation, axis=(1, 2)), 0, np.arccos(along.clip(0, 1)))
    resized = np.abs(after.size_m.astype(float) / was.size_m - 1).max(axis=1, initial=0)
    touched = copied | (moved_m > 0) | (turned_rad > 0) | (resized > 0) | (after.category != was.category)
    touched |= (after.label != was.label) | ((after.heading_rad != was.heading_rad) & ~np.isnan(was.heading_rad))
    nothing = np.zeros(len(removed))
    return ObjectChange(
        np.append(removed, origin[touched]),
        np.append(np.full(len(removed), "removed"), np.where(copied, "copied", "changed")[touched]),
        np.append(nothing, moved_m[touched]),
        np.append(nothing, turned_rad[touched]),
        np.append(nothing, resized[touched]),
    )


def replay_edits(scene: Scene, edits: Sequence[Edit]) -> tuple[Scene, list[ObjectChange]]:
    """Apply edits in order, and report the changes of each.

    The numbers of primitives are those before each edit; after a removal the numbers of later primitives decrease.
    Raises ValueError naming an edit that fails.
    """
    done = []
    for step, edit in enumerate(edits):
        try:
            after, origin = edit.apply_to(scene, edit.select.select_primitives(scene))
        except ValueError as error:
            raise ValueError(f"edit {step} ({edit.name}): {error}") from error
        done.append(compare_objects(scene, after, origin))
        scene = after
    return scene, done


def serialize_edits(edits: Sequence[Edit]) -> list[dict]:
    """Edits as JSON objects, tuples as lists; what has its default is left out."""
    return json.loads(json.dumps([{"edit": edit.name, **_describe_value(edit)} for edit in edits]))


def _describe_value(value: Edit | Select) -> dict:
    plain = {f.name: f.default for f in fields(value)}
    said = {name: content for name, content in asdict(value).items() if content != plain[name]}
    if isinstance(value, Edit):
        said["select"] = _describe_value(value.select)
    return said


def parse_edits(content: object) -> list[Edit]:
    """The edits of a JSON list. Raises ValueError that names the edit and what is wrong with it."""
    if not isinstance(content, list) or not all(isinstance(entry, dict) for entry in content):
        raise ValueError("a list of edits is a JSON list of objects, each with 'edit' and 'select'")
    edits = []
    for step, entry in enumerate(content):
        kind, rest = entry.get("edit"), {name: value for name, value in entry.items() if name != "edit"}
        if kind not in EDITS:
            raise ValueError(f"edit {step}: 'edit' is {json.dumps(kind)}, expected one of: {', '.join(EDITS)}")
        try:
            edits.append(TypeAdapter(EDITS[kind]).validate_json(json.dumps(rest), strict=True))
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            known = fields(Select if len(first["loc"]) > 1 and first["loc"][0] == "select" else EDITS[kind])
            takes = ", ".join(f.name for f in known)
            raise ValueError(f"edit {step} ({kind}): {where}: {first['msg']}; it takes {takes}") from error
    return edits
