"""Edit the primitives of a scene: select primitives, change their parameters exactly, and record the changes.

A list of edits is plain data. Applying the same list to the same scene gives a bit-identical result. The list can also
be applied to other scenes. An edit in JSON is an object such as

    {"edit": "translate", "select": {"category": ["vehicle_small"], "where": "length_m > 4"}, "by_m": [5, 0, 0]}
"""

from __future__ import annotations

import json
import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Literal, NamedTuple

import duckdb
import numpy as np
import pyarrow as pa
from pydantic import ConfigDict, TypeAdapter, ValidationError

from models.composition.inpaint import contains_points
from models.layout import SLAB_OFFSET_M
from models.scene import (
    CATEGORIES,
    CATEGORY_INDEX,
    Scene,
    canonicalize_boxes,
    concatenate_primitives,
    make_yaw_rotation,
)
from pipelines.editing.repair import GroundFaults, find_removable_objects, separate_objects, snap_to_ground
from pipelines.schema.columns import PRIMITIVES
from pipelines.schema.conversion import make_primitives_table
from pipelines.schema.validation import MAX_COORDINATE_M

SIZES_M = (1e-3, 1e3)  # Smallest and largest size after an edit.
WHERE_S, WHERE_MEMORY = 10.0, "1GB"  # Largest time (s) and memory of an SQL condition.


@dataclass(frozen=True)
class Select:
    """Selection of the primitives that satisfy all conditions."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    category: tuple[str, ...] = ()
    """Categories of the primitives."""
    primitives: tuple[int, ...] = ()
    """Indices of the primitives (from 0), in the order of the scene's rows in the primitives table."""
    instances: tuple[int, ...] = ()
    """Values of instance_id."""
    polygon_m: tuple[float, ...] = ()
    """Polygon that contains the centre of the primitive: x and y of each corner in the scene frame (m)."""
    where: str = ""
    """SQL condition on columns of the primitives table, such as "length_m > 4 and y_m < 0"; "true" selects all."""

    def check(self) -> None:
        """Check the conditions without a scene.

        Raises:
            ValueError: No condition is given, a category is unknown, or the SQL condition is invalid.
        """
        self._check_names()
        if self.where:
            _evaluate_where(PRIMITIVES.empty_table(), self.where)

    def _check_names(self) -> None:
        if self == Select():
            raise ValueError("the selection has no condition; give category, primitives, instances, polygon_m or where")
        for name in self.category:
            _parse_category(name)
        if len(self.polygon_m) % 2:
            raise ValueError(f"the polygon has {len(self.polygon_m)} numbers, expected pairs x y of coordinates (m)")

    def select_primitives(self, scene: Scene) -> np.ndarray:
        """Select primitives of a scene.

        Args:
            scene: Scene with n primitives.

        Returns:
            (n,) bool.

        Raises:
            ValueError: The conditions are invalid, or an index in `primitives` is outside the scene.
        """
        self._check_names()
        fits = np.ones(len(scene), bool)
        if self.category:
            fits &= np.isin(scene.category, [_parse_category(name) for name in self.category])
        if self.primitives:
            numbers = ", ".join(map(str, self.primitives))
            if not -1 < min(self.primitives) <= max(self.primitives) < len(scene):
                raise ValueError(
                    f"scene {scene.scene_id} has {len(scene)} primitives, numbered from 0; got the numbers {numbers}"
                )
            fits &= np.isin(np.arange(len(scene)), self.primitives)
        if self.instances:
            fits &= np.isin(scene.instance_id, self.instances)
        if self.polygon_m:
            fits &= contains_points(np.reshape(self.polygon_m, (-1, 2)), *scene.center_m[:, :2].T)
        if self.where:
            fits &= _evaluate_where(make_primitives_table([scene]), self.where)
        return fits


def _evaluate_where(table: pa.Table, condition: str) -> np.ndarray:
    """Return a mask (n,): whether each row of a primitives table satisfies an SQL condition.

    The condition can read no file, and its time and memory are limited.
    """
    table = table.append_column("row", pa.array(np.arange(len(table))))
    with duckdb.connect(config={"enable_external_access": False, "memory_limit": WHERE_MEMORY}) as connection:
        timer = threading.Timer(WHERE_S, connection.interrupt)
        timer.start()
        try:
            rows = connection.from_arrow(table).filter(condition).project("row").fetchnumpy()["row"]
        except duckdb.InterruptException as error:
            raise ValueError(f"the where condition {condition!r} takes more than {WHERE_S:g} s; simplify it") from error
        except duckdb.Error as error:
            first = str(error).splitlines()[0]
            raise ValueError(
                f"the where condition {condition!r} is invalid: {first}; docs/reference/tables.md lists the columns;"
                " write text in 'single quotes'"
            ) from error
        finally:
            timer.cancel()
    return np.isin(np.arange(len(table)), rows)


@dataclass(frozen=True)
class Edit(ABC):
    """One change of selected primitives."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    select: Select = field(default_factory=Select)

    @property
    def name(self) -> str:
        """Name of the edit in JSON."""
        return type(self).__name__.lower()

    def check(self) -> None:
        """Check the edit without a scene.

        Raises:
            ValueError: The edit is invalid regardless of the scene, or the edit has no effect.
        """
        self.select.check()

    @abstractmethod
    def apply_to(self, scene: Scene, chosen: np.ndarray) -> tuple[Scene, np.ndarray]:
        """Apply the edit to selected primitives of a scene.

        Args:
            scene: Scene with n primitives.
            chosen: (n,) bool; the selected primitives.

        Returns:
            The edited scene with m primitives, and an array (m,). For each primitive of the edited scene, the array
            holds the index of this primitive in `scene`.

        Raises:
            ValueError: A primitive of the result has an invalid position or size.
        """


class ObjectEdit(Edit):
    """An edit that keeps the number and the order of the primitives."""

    @abstractmethod
    def transform(self, part: Scene) -> Scene:
        """Change primitives.

        Args:
            part: Scene with only the selected primitives and the ground of the whole scene.

        Returns:
            The same primitives after the edit, in the same order.
        """

    def apply_to(self, scene: Scene, chosen: np.ndarray) -> tuple[Scene, np.ndarray]:
        """Apply the edit to selected primitives of a scene.

        Args:
            scene: Scene with n primitives.
            chosen: (n,) bool; the selected primitives.

        Returns:
            The edited scene, and the indices 0 .. n - 1, because no primitive changes its index.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            part = require_valid_objects(self.transform(scene.select(chosen)))
        place = np.arange(len(scene))
        place[chosen] = len(scene) + np.arange(len(part))
        return replace(scene, **concatenate_primitives([scene, part])).select(place), np.arange(len(scene))


def require_valid_objects(part: Scene) -> Scene:
    """Check the positions and sizes of primitives.

    Args:
        part: Scene after an edit.

    Returns:
        The same scene.

    Raises:
        ValueError: A position is not finite or too far away for the tables, or a size lies outside 1 mm to 1 km.
    """
    size_m = part.size_m
    if not (np.abs(part.center_m) <= MAX_COORDINATE_M).all():
        raise ValueError(
            f"a primitive of scene {part.scene_id} would lie beyond {MAX_COORDINATE_M:,.0f} m; use a shorter way"
        )
    if not ((size_m >= SIZES_M[0]) & (size_m <= SIZES_M[1])).all():
        raise ValueError(
            f"a primitive of scene {part.scene_id} would have a size outside 1 mm to 1 km or a value that is not finite"
        )
    return part


@dataclass(frozen=True)
class Remove(Edit):
    """Remove the selected primitives."""

    def apply_to(self, scene: Scene, chosen: np.ndarray) -> tuple[Scene, np.ndarray]:
        """Remove the selected primitives.

        Args:
            scene: Scene with n primitives.
            chosen: (n,) bool; the selected primitives.

        Returns:
            The scene without the selected primitives, and the index in `scene` of each remaining primitive.
        """
        return scene.select(~chosen), np.flatnonzero(~chosen)


@dataclass(frozen=True)
class Duplicate(Edit):
    """Append displaced copies of the selected primitives. A copy has no instance_id."""

    by_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Displacement of the copies in the scene frame: x (forward), y (left), z (up), in metres."""

    def check(self) -> None:
        """Check the edit without a scene.

        Raises:
            ValueError: The selection is invalid, or the displacement is 0 or not finite.
        """
        super().check()
        _check_way(self.by_m)

    def apply_to(self, scene: Scene, chosen: np.ndarray) -> tuple[Scene, np.ndarray]:
        """Append copies of the selected primitives.

        Args:
            scene: Scene with n primitives.
            chosen: (n,) bool; the selected primitives.

        Returns:
            The edited scene, and the index that each of its primitives has in `scene`. A copy has the index of its
            original.
        """
        copies = require_valid_objects(Translate(by_m=self.by_m).transform(scene.select(chosen)))
        copies = replace(copies, instance_id=np.full(len(copies), -1, np.int64))
        return replace(scene, **concatenate_primitives([scene, copies])), np.append(
            np.arange(len(scene)), np.flatnonzero(chosen)
        )


@dataclass(frozen=True)
class Translate(ObjectEdit):
    """Move the selected primitives."""

    by_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Displacement along the three axes of the frame `along`, in metres."""
    along: Literal["scene", "own"] = "scene"
    """Axes of the displacement. "scene" means x (forward), y (left) and z (up) of the scene frame. "own" means the
    length, width and height axes of each primitive; a known heading sets the sign of the length axis.
    """

    def check(self) -> None:
        """Check the edit without a scene.

        Raises:
            ValueError: The selection is invalid, or the displacement is 0 or not finite.
        """
        super().check()
        _check_way(self.by_m)

    def transform(self, part: Scene) -> Scene:
        """Move primitives.

        Args:
            part: Scene with only the selected primitives.

        Returns:
            The moved primitives.
        """
        way_m = np.broadcast_to(np.array(self.by_m, float), (len(part), 3))
        if self.along == "own":
            ahead = np.stack([np.cos(part.heading_rad), np.sin(part.heading_rad), np.zeros(len(part))], axis=1)
            # An unknown heading (NaN) does not count as backward.
            backward = (part.rotation[:, :, 0] * ahead).sum(axis=1) < 0
            turned = part.rotation * np.where(backward[:, None], [-1, -1, 1], 1)[:, None, :]
            way_m = (turned @ way_m[:, :, None])[:, :, 0]
        return replace(part, center_m=(part.center_m + way_m).astype(np.float32))


@dataclass(frozen=True)
class Rotate(ObjectEdit):
    """Rotate the selected primitives about a vertical axis. Positive angles are counter-clockwise seen from above."""

    by_deg: float = 0.0
    """Angle in degrees."""
    about_m: tuple[float, float] | None = None
    """Position (x, y) of the vertical axis in the scene frame, in metres (default: the centre of each primitive)."""

    def check(self) -> None:
        """Check the edit without a scene.

        Raises:
            ValueError: The selection is invalid, the angle is not finite, or the angle is a multiple of 360 degrees.
        """
        super().check()
        if not np.isfinite(self.by_deg) or self.by_deg % 360 == 0:
            raise ValueError(f"a rotation by {self.by_deg} degrees changes nothing")

    def transform(self, part: Scene) -> Scene:
        """Rotate primitives.

        Args:
            part: Scene with only the selected primitives.

        Returns:
            The rotated primitives.
        """
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
    """Scale the selected primitives along their own axes."""

    by: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Scale factors of length, width and height."""
    hold: Literal["bottom", "centre"] = "bottom"
    """Point of each primitive that remains fixed."""

    def check(self) -> None:
        """Check the edit without a scene.

        Raises:
            ValueError: The selection is invalid, a factor is 0 or negative, or all factors are 1.
        """
        super().check()
        if not all(np.isfinite(self.by)) or min(self.by) <= 0 or set(self.by) == {1}:
            raise ValueError(f"the scale factors are {list(self.by)}, expected values > 0 that are not all 1")

    def transform(self, part: Scene) -> Scene:
        """Scale primitives.

        Args:
            part: Scene with only the selected primitives.

        Returns:
            The scaled primitives.
        """
        rotation, size_m = canonicalize_boxes(part.rotation, part.size_m * np.array(self.by, np.float32))
        part_scaled = replace(part, rotation=rotation, size_m=size_m)
        if self.hold == "centre":
            return part_scaled
        up_m = part.bottom_m - part_scaled.bottom_m
        return replace(part_scaled, center_m=_raise_objects(part, up_m))


@dataclass(frozen=True)
class Relabel(ObjectEdit):
    """Change the category.

    If the new category is vegetation_ellipsoid, the primitive becomes an ellipsoid. Otherwise, the primitive becomes a
    cuboid.
    """

    category: str = "object"
    """New category."""
    label: str | None = None
    """Class name in the source dataset (default: the name of the category)."""

    def check(self) -> None:
        """Check the edit without a scene.

        Raises:
            ValueError: The selection is invalid, or the category is unknown.
        """
        super().check()
        _parse_category(self.category)

    def transform(self, part: Scene) -> Scene:
        """Change the category and the label of primitives.

        Args:
            part: Scene with only the selected primitives.

        Returns:
            The relabelled primitives.
        """
        index, label = _parse_category(self.category), self.label or self.category
        return replace(part, category=np.full_like(part.category, index), label=np.full(len(part), label, object))


@dataclass(frozen=True)
class Snap(ObjectEdit):
    """Move the lowest point of each primitive to the ground height under its centre.

    A primitive without ground below is not moved.
    """

    slab_offset_m: float = SLAB_OFFSET_M
    """Height of the ground raster above the real surface, in m: 0.3 for KITTI-360 and the town, 0 for Argoverse 2."""

    def transform(self, part: Scene) -> Scene:
        """Move primitives vertically to the ground.

        Args:
            part: Scene with only the selected primitives and the ground of the whole scene.

        Returns:
            The moved primitives.
        """
        height_m, _ = part.ground_under()
        above_m = part.bottom_m - (height_m - self.slab_offset_m)
        return replace(part, center_m=_raise_objects(part, -np.nan_to_num(above_m)))


@dataclass(frozen=True)
class Repair(Edit):
    """Repair faults (metrics/validity.py): snap to the ground, separate overlaps, or remove primitives."""

    slab_offset_m: float = SLAB_OFFSET_M
    """Height of the ground raster above the real surface, in metres. The edit `snap` has the same option."""
    ground: GroundFaults = "both"
    """Primitives to move to the ground: floating, sunken, both or none."""
    push_m: float = 0.25
    """Maximum horizontal displacement of each overlapping primitive, in metres."""
    shrink: float = 0.95
    """Minimum scale factor of a primitive. Primitives are scaled only if a displacement does not end the overlap."""
    drop: bool = True
    """Whether to remove one primitive of each pair that still overlaps."""

    def check(self) -> None:
        """Check the edit without a scene.

        Raises:
            ValueError: The selection is invalid, or push_m or shrink lies outside its range.
        """
        super().check()
        if not 0 <= self.push_m < np.inf:
            raise ValueError(f"push_m is {self.push_m}, expected a finite distance >= 0 m")
        if not 0 < self.shrink <= 1:
            raise ValueError(f"shrink is {self.shrink}, expected a factor in (0, 1]; 1 means no shrinking")

    def apply_to(self, scene: Scene, chosen: np.ndarray) -> tuple[Scene, np.ndarray]:
        """Repair selected primitives of a scene.

        Args:
            scene: Scene with n primitives.
            chosen: (n,) bool; the selected primitives.

        Returns:
            The repaired scene, and the index in `scene` of each remaining primitive.

        Raises:
            ValueError: A primitive of the result has an invalid position or size.
        """
        scene = snap_to_ground(scene, chosen, self.slab_offset_m, self.ground)
        scene = require_valid_objects(separate_objects(scene, chosen, self.push_m, self.shrink))
        # Snap again, because a displacement may have moved a primitive on a slope.
        scene = snap_to_ground(scene, chosen, self.slab_offset_m, self.ground)
        gone = find_removable_objects(scene, chosen) if self.drop else np.zeros(len(scene), bool)
        return scene.select(~gone), np.flatnonzero(~gone)


EDITS = {kind.__name__.lower(): kind for kind in (Remove, Duplicate, Translate, Rotate, Scale, Relabel, Snap, Repair)}


def _raise_objects(part: Scene, up_m: np.ndarray) -> np.ndarray:
    """Return the centres (n, 3), displaced upwards by up_m (n,)."""
    return (part.center_m + up_m[:, None] * np.array([0.0, 0.0, 1.0])).astype(np.float32)


def _check_way(by_m: Sequence[float]) -> None:
    if not (np.abs(by_m) <= MAX_COORDINATE_M).all() or not any(by_m):
        raise ValueError(
            f"by_m is {list(by_m)}, expected metres along x, y and z that are not all 0 and at most"
            f" {MAX_COORDINATE_M:,.0f}"
        )


def _parse_category(name: str) -> int:
    if name not in CATEGORY_INDEX:
        raise ValueError(f"category {name!r} is unknown, expected one of: {', '.join(CATEGORIES)}")
    return CATEGORY_INDEX[name]


class ObjectChange(NamedTuple):
    """Changes that one edit makes, with one entry per changed primitive.

    Attributes:
        primitive: Index of the primitive in the scene before the edit.
        change: One of removed, copied and changed.
        moved_m: Displacement of the centre (m). If the primitive is a copy, the distance from its original (m).
        turned_rad: Largest rotation angle of an axis (rad). Opposite directions of an axis are equivalent.
        resized: Largest relative change of length, width or height.
    """

    primitive: np.ndarray  # (k,) int
    change: np.ndarray  # (k,) str
    moved_m: np.ndarray  # (k,) float64
    turned_rad: np.ndarray  # (k,) float64
    resized: np.ndarray  # (k,) float64


def compare_objects(before: Scene, after: Scene, origin: np.ndarray) -> ObjectChange:
    """Report the changes between a scene and its edited version.

    Args:
        before: Scene before the edit.
        after: Scene after the edit, with m primitives.
        origin: (m,) indices. For each primitive of `after`, its index in `before`.

    Returns:
        One entry per removed, copied or changed primitive.
    """
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
    """Apply edits in order, and report the changes of each edit.

    The index of a primitive refers to the input of the respective edit. After a removal, all primitives that follow the
    removed primitive therefore have smaller indices.

    Args:
        scene: Scene.
        edits: Edits.

    Returns:
        The edited scene, and the changes of each edit.

    Raises:
        ValueError: An edit fails; the message names the edit.
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
    """Convert edits to JSON objects.

    Args:
        edits: Edits.

    Returns:
        One dictionary per edit. Tuples become lists, and fields with their default value are omitted.
    """
    return json.loads(json.dumps([{"edit": edit.name, **_describe_value(edit)} for edit in edits]))


def _describe_value(value: Edit | Select) -> dict:
    plain = {f.name: f.default for f in fields(value)}
    said = {name: content for name, content in asdict(value).items() if content != plain[name]}
    if isinstance(value, Edit):
        said["select"] = _describe_value(value.select)
    return said


def parse_edits(content: object) -> list[Edit]:
    """Parse a JSON list of edits.

    Args:
        content: Parsed JSON.

    Returns:
        The edits.

    Raises:
        ValueError: The content is invalid; the message names the edit and the fault.
    """
    if not isinstance(content, list) or not all(isinstance(entry, dict) for entry in content):
        raise ValueError("the edits must be a JSON list of objects, each with the keys 'edit' and 'select'")
    edits = []
    for step, entry in enumerate(content):
        kind, rest = entry.get("edit"), {name: value for name, value in entry.items() if name != "edit"}
        if not isinstance(kind, str) or kind not in EDITS:
            raise ValueError(f"edit {step}: 'edit' is {json.dumps(kind)[:80]}, expected one of: {', '.join(EDITS)}")
        try:
            edits.append(TypeAdapter(EDITS[kind]).validate_json(json.dumps(rest), strict=True))
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            known = fields(Select if len(first["loc"]) > 1 and first["loc"][0] == "select" else EDITS[kind])
            takes = ", ".join(f.name for f in known)
            raise ValueError(f"edit {step} ({kind}): {where}: {first['msg']}; the valid fields are {takes}") from error
    return edits
