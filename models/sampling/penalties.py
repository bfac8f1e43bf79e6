"""Differentiable penalties (m) that measure how physically implausible decoded layouts are.

`constraints.py` lowers these penalties during sampling. A penalty is a sum over objects or pairs of objects. Each term
is multiplied by the existence probability, and it is zero for a valid object. The penalties have no gradient with
respect to the ground or the existence probabilities. Otherwise, sampling would remove roads and objects instead of
moving objects. A displaced latent can still change existence probabilities; `constraints.py` penalises this change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn import functional as F

from models.geometry.cholesky import MIN_EXTENT_M, TRIL
from models.geometry.iou3d import make_boxes
from models.geometry.suppression import find_redundant
from models.layout import LayoutSpec
from models.scene import (
    CATEGORIES,
    CATEGORY_INDEX,
    ELLIPSOID,
    ROAD_CLASSES,
    SUPPORT_M,
    SUPPORTERS,
    VEGETATION,
    VEHICLES,
)
from models.vae.local_frame import locate_in_raster
from models.vae.outputs import LayoutOutput

MIN_EXISTENCE = 0.2  # Proposals with a lower existence probability have no penalty.

# Unordered pairs of categories whose overlap is no fault, because real objects overlap as well. Vegetation overlaps
# everything. In 256 test scenes of town version 1, the other pairs overlap (25 % of the smaller volume) 0.16 to 3.1
# times per scene: crossing fences, signs on poles, boxes at walls. Each remaining pair of categories, except those of
# DEEP_PAIRS, overlaps at most 0.04 times per scene.
TOUCHING_PAIRS = (
    ("construction_small", "construction_small"),
    ("construction_small", "object"),
    ("object", "object"),
    ("pole", "pole"),
    ("pole", "traffic_control"),
    ("traffic_control", "traffic_control"),
    ("vehicle_small", "pole"),
)
PENETRATION_TOLERANCE_M = 0.1  # Rounding of the town's tables and of the decoder.
# Depth (m) up to which these pairs have no penalty: the 95 % quantile of the depths of overlapping pairs in 300 test
# scenes of town version 2.
DEEP_PAIRS = {("construction_big", "construction_small"): 1.0, ("construction_big", "object"): 0.7}

# Largest depth below and height above the ground (m) that has no penalty. Source: 1 % and 99 % of the gaps in 256 test
# scenes of each version of the town, rounded up to multiples of 0.05 m; the larger value of both versions. Only a
# centre on annotated ground counts. Objects of version 2 stand deeper than those of version 1.
HEIGHT_TOLERANCE_M = {
    "vehicle_big": (0.15, 0.05),
    "vehicle_small": (0.1, 0.05),
    "two_wheelers": (0.15, 0.05),
    "human": (0.1, 0.05),
    "construction_big": (1.45, 0.1),
    "construction_small": (1.1, 0.05),
    "pole": (0.3, 0.05),
    "object": (0.4, 0.05),
}

# Area (m2) of a footprint on the sidewalk that has no penalty: 99 % of the buildings and walls of town version 1
# have less (version 2: 0.0 and 2.2). On the road, the largest area in version 1 is 0.91 m2.
SIDEWALK_TOLERANCE_M2 = {"construction_big": 2.0, "construction_small": 3.3}
FOOTPRINT_BLUR_M = 4.0  # Width of the box filter that gives footprints on the road a direction to move.
MIN_PROBABILITY = 0.05  # Points with a lower probability of road do not move a footprint.
FOOTPRINT_POINTS = 17  # Points along each side of a footprint; the outer points lie on its border.

SUPPORT_RANGE_M = 4.0  # Signs farther from each supporter have no penalty: no small displacement attaches them.
SUPPORT_SPREAD_M = 0.25  # Width of the soft minimum over the supporters.

LANE_WINDOW_M = 8.0  # Half of the window in which the direction of the road is measured.
LANE_SPREAD_M = 4.0  # Standard deviation of the Gaussian weights in this window.
LANE_SAMPLES = 17  # Samples along each side of the window.
LANE_TOLERANCE_RAD = 0.1  # 90 % of the vehicles of town version 1 deviate by less (0.09; version 2: 0.07).
LANE_LENGTH_M = 2.0  # Converts sin^2 of the angle to metres: half the length of a car.

# Objects that are parallel or perpendicular to the nearest edge of the road.
ALIGNED = ("vehicle_big", "vehicle_small", "two_wheelers", "construction_big", "construction_small")
EDGE_PIXEL_M = 1.0  # Resolution of the nearest edges of the road.
EDGE_RANGE_M = 30.0  # Objects farther from the road have no penalty on their alignment.
# In 256 test scenes of town version 2, 95 % of the vehicles, 88 % of the walls, 80 % of the buildings and 70 % of the
# two-wheelers deviate by less.
ALIGNMENT_TOLERANCE_RAD = 0.1
ALIGNMENT_LENGTH_M = 2.0  # Converts sin^2 of twice the angle to metres.
MIN_COHERENCE = 0.5  # Below this coherence, for example at junctions, the road has no direction.
MIN_ELONGATION = 0.1  # Horizontal extents that differ by a smaller share have an unstable yaw.


class Objects(NamedTuple):
    """Objects of several layouts that have a gradient. The axes are those of boxes; axis 2 is the most vertical one.

    Attributes:
        scene: Index of the layout.
        category: Index into CATEGORIES.
        existence: Existence probability, without gradient.
        center_m: Centres.
        axes: Matrices whose columns are the axes. Their gradient is that of the yaw.
        size_m: Full extents along the axes.
        double_yaw: Cosine and sine of twice the yaw of the longer horizontal axis.
    """

    scene: Int[Tensor, " n"]
    category: Int[Tensor, " n"]
    existence: Float[Tensor, " n"]
    center_m: Float[Tensor, "n 3"]
    axes: Float[Tensor, "n 3 3"]
    size_m: Float[Tensor, "n 3"]
    double_yaw: Float[Tensor, "n 2"]

    def take(self, index: Tensor) -> Objects:
        """Select objects.

        Args:
            index: Indices or mask.

        Returns:
            The selected objects.
        """
        return Objects(*(part[index] for part in self))

    def is_any(self, categories: Sequence[int]) -> Bool[Tensor, " n"]:
        """Test whether objects belong to some categories.

        Args:
            categories: Indices into CATEGORIES.

        Returns:
            (n,) bool.
        """
        return torch.isin(self.category, self.category.new_tensor(categories))


@dataclass(frozen=True, eq=False)
class Ground:
    """Decoded ground without gradient.

    Attributes:
        probability: Probability of each ground class.
        height_m: Height of each ground class above the scene frame's origin.
        spec: Layout of the scenes.
    """

    probability: Float[Tensor, "b ground rows cols"]
    height_m: Float[Tensor, "b ground rows cols"]
    spec: LayoutSpec

    @cached_property
    def road(self) -> Float[Tensor, "b rows cols"]:
        """Probability of road."""
        return self.find_classes(ROAD_CLASSES)

    @cached_property
    def forbidden(self) -> tuple[Tensor, Tensor]:
        """Probabilities of road and of sidewalk outside the road, both (b, 2, rows, cols): sharp, then blurred."""
        maps = torch.stack([self.road, self.find_classes(("sidewalk",)) * (1 - self.road)], dim=1)
        return maps, _blur(maps, self.spec.grid.resolution_m)

    @cached_property
    def slopes(self) -> Float[Tensor, "b 3 rows cols"]:
        """Products of the slopes of the probability of road: dx^2 - dy^2, 2 dx dy, dx^2 + dy^2."""
        dx, dy = (torch.zeros_like(self.road) for _ in range(2))  # Rows run against x, columns against y.
        dx[:, 1:-1] = (self.road[:, :-2] - self.road[:, 2:]) / 2
        dy[:, :, 1:-1] = (self.road[:, :, :-2] - self.road[:, :, 2:]) / 2
        return torch.stack([dx * dx - dy * dy, 2 * dx * dy, dx * dx + dy * dy], dim=1)

    @cached_property
    def edges(self) -> tuple[Float[Tensor, "b 2 rows cols"], Float[Tensor, "b 1 rows cols"]]:
        """Direction of the nearest edge of the road, as cosine and sine of the doubled angle, and its distance (m)."""
        factor = max(1, round(EDGE_PIXEL_M / self.spec.grid.resolution_m))
        pixel_m = factor * self.spec.grid.resolution_m
        slopes = _blur(F.avg_pool2d(self.slopes, factor), pixel_m)
        along = -slopes[:, :2] / torch.hypot(slopes[:, 0], slopes[:, 1]).clamp(min=1e-9)[:, None]
        is_road = F.avg_pool2d(self.road[:, None], factor)[:, 0] > 0.5
        is_edge = is_road & (F.max_pool2d((~is_road).float()[:, None], 3, 1, 1)[:, 0] > 0)
        found, distances_m = torch.zeros_like(along), torch.full_like(along[:, :1], torch.inf)
        for k, mask in enumerate(is_edge.cpu().numpy()):
            if mask.any():
                distance, nearest = cast(tuple[np.ndarray, ...], distance_transform_edt(~mask, return_indices=True))
                row, col = torch.from_numpy(nearest)
                found[k] = along[k][:, row, col]
                distances_m[k, 0] = torch.from_numpy(distance * pixel_m)
        return found, distances_m

    def find_classes(self, names: Sequence[str]) -> Float[Tensor, "b rows cols"]:
        """Find the probability that a pixel has at least one of some classes.

        Args:
            names: Names of ground classes.

        Returns:
            Probability; 0 if the model lacks all of the classes.
        """
        index = [k for k, name in enumerate(self.spec.ground_classes) if name in names]
        return self.probability[:, index].amax(dim=1) if index else torch.zeros_like(self.probability[:, 0])

    def contains(self, xy_m: Float[Tensor, "*points 2"]) -> Bool[Tensor, "*points"]:
        """Test whether points lie inside the grid.

        Args:
            xy_m: Points (m, scene frame).

        Returns:
            Booleans.
        """
        return self.spec.grid.contains(*xy_m.unbind(dim=-1))

    def sample(self, maps: Float[Tensor, "b k rows cols"], scene: Tensor, xy_m: Tensor) -> Tensor:
        """Interpolate maps bilinearly.

        Args:
            maps: Maps on the grid of the layout.
            scene: (n,) index of the layout of each row of points.
            xy_m: (n, p, 2) points (m, scene frame).

        Returns:
            (n, k, p) values; outside the grid, the value of the nearest pixel.
        """
        place = locate_in_raster(xy_m, self.spec.grid)  # (n, p, 2)
        parts = [
            (index := torch.nonzero(scene == one)[:, 0], F.grid_sample(
                maps[one : one + 1], place[index][None], "bilinear", "border", align_corners=False
            )[0].transpose(0, 1))
            for one in scene.unique().tolist()
        ]  # fmt: skip
        if not parts:
            return xy_m.new_zeros(0, maps.shape[1], xy_m.shape[1])
        order = torch.cat([index for index, _ in parts]).argsort()
        return torch.cat([values for _, values in parts])[order]

    def find_surface(self, scene: Tensor, xy_m: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
        """Find the height of the surface on which objects stand. The highest class is the surface (`Scene.surface`).

        Args:
            scene: (n,) index of the layout of each point.
            xy_m: Points (m, scene frame).

        Returns:
            Heights (m, scene frame); NaN where there is no ground.
        """
        count = len(self.spec.ground_classes)
        found = self.sample(torch.cat([self.probability, self.height_m], dim=1), scene, xy_m[:, None])[..., 0]
        probability, height_m = found.split(count, dim=1)
        top_m = torch.where(probability > 0.5, height_m, -torch.inf).amax(dim=1)
        return torch.where(torch.isfinite(top_m), top_m - self.spec.slab_offset_m, torch.nan)


@dataclass(frozen=True)
class Constraint:
    """A penalty and the parts of a layout that it needs.

    Attributes:
        categories: Groups of categories; the model needs at least one category of each group.
        ground_classes: Ground classes, of which the model needs at least one.
    """

    categories: tuple[tuple[str, ...], ...]
    ground_classes: tuple[str, ...] = ()

    def find_missing(self, spec: LayoutSpec) -> tuple[str, ...]:
        """Find a group that a layout lacks.

        Args:
            spec: Layout.

        Returns:
            The first group of which the layout has no member; an empty tuple if there is none.
        """
        groups = [(group, spec.categories) for group in self.categories]
        groups += [(self.ground_classes, spec.ground_classes)] if self.ground_classes else []
        return next((group for group, known in groups if not set(group) & set(known)), ())


SOLID_NAMES = tuple(name for index, name in enumerate(CATEGORIES) if index not in VEGETATION)
SUPPORTER_NAMES = tuple(CATEGORIES[index] for index in SUPPORTERS)
VEHICLE_NAMES = tuple(CATEGORIES[index] for index in VEHICLES)
CONSTRAINTS = {
    "penetration": Constraint((SOLID_NAMES,)),
    "footprint": Constraint((tuple(SIDEWALK_TOLERANCE_M2),), (*ROAD_CLASSES, "sidewalk")),
    "height": Constraint((tuple(HEIGHT_TOLERANCE_M),)),
    "support": Constraint((("traffic_control",), SUPPORTER_NAMES)),
    "heading": Constraint((VEHICLE_NAMES,), ROAD_CLASSES),
    "alignment": Constraint((ALIGNED,), ROAD_CLASSES),
}


def select_constraints(spec: LayoutSpec, names: Sequence[str] | None = None) -> tuple[str, ...]:
    """Return the constraints that apply to a layout.

    Args:
        spec: Layout of the model.
        names: Requested constraints. None: all constraints whose categories and ground classes the model has.

    Returns:
        Names, keys of CONSTRAINTS.

    Raises:
        ValueError: A requested constraint is unknown, or the model lacks its categories or ground classes.
    """
    for name in names or ():
        if name not in CONSTRAINTS:
            raise ValueError(f"constraint {name!r} is unknown, expected some of: {', '.join(CONSTRAINTS)}")
        if missing := CONSTRAINTS[name].find_missing(spec):
            raise ValueError(
                f"constraint {name!r} needs at least one of {', '.join(missing)}, but the model has only the categories"
                f" {', '.join(spec.categories)} and the ground classes {', '.join(spec.ground_classes)}; leave out the"
                " constraint"
            )
    return tuple(names if names is not None else (n for n, c in CONSTRAINTS.items() if not c.find_missing(spec)))


# ------------------------------------------------------------------------------------------------------------ decoding


def make_ground(output: LayoutOutput, spec: LayoutSpec) -> Ground:
    """Convert the ground of decoded layouts to metres and probabilities, without gradient.

    Args:
        output: Output of the decoders.
        spec: Layout of the model.

    Returns:
        Ground.
    """
    (low,), (high,) = spec.height_bounds_m.low, spec.height_bounds_m.high
    height_m = output.height.detach().float() * (high - low) + low
    return Ground(output.occupancy_logit.detach().float().sigmoid(), height_m, spec)


def find_objects(
    features: Float[Tensor, "b proposals 9"],
    existence_logit: Float[Tensor, "b proposals"],
    proposals: Sequence[int],
    spec: LayoutSpec,
    has_duplicates: bool = False,
) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Find the proposals that have penalties: probable objects that are no vegetation.

    Non-maximum suppression removes duplicates from decoded scenes. The function leaves the same duplicates out.
    Otherwise, the penalty of penetration would push two proposals for one object apart, and both would be kept.

    Args:
        features: Normalised features.
        existence_logit: Logits of the existence probabilities.
        proposals: Number of proposals per category of the layout.
        spec: Layout of the model.
        has_duplicates: Whether the decoder may propose an object twice.

    Returns:
        Scene and proposal of each object.
    """
    category = _list_categories(proposals, spec, features.device)
    is_solid = ~torch.isin(category, category.new_tensor(VEGETATION))
    usable = torch.isfinite(features).all(dim=2) & (existence_logit.float().sigmoid() >= MIN_EXISTENCE)
    scene, slot = (usable & is_solid).nonzero(as_tuple=True)
    if not has_duplicates:
        return scene, slot
    objects = make_objects(features.detach(), existence_logit, proposals, spec, (scene, slot))
    boxes = make_boxes(*(part.double().cpu().numpy() for part in (objects.center_m, objects.axes, objects.size_m)))
    kinds, existence, owner = (part.cpu().numpy() for part in (objects.category, objects.existence, scene))
    kept = np.ones(len(owner), bool)
    for one in np.unique(owner):
        members = np.flatnonzero(owner == one)
        kept[members[find_redundant(boxes.take(members), kinds[members], existence[members])]] = False
    index = torch.from_numpy(np.flatnonzero(kept)).to(scene.device)
    return scene[index], slot[index]


def make_objects(
    features: Float[Tensor, "b proposals 9"],
    existence_logit: Float[Tensor, "b proposals"],
    proposals: Sequence[int],
    spec: LayoutSpec,
    chosen: tuple[Int[Tensor, " n"], Int[Tensor, " n"]],
) -> Objects:
    """Convert proposals of a decoder to objects with a gradient.

    The axes of a box are eigenvectors, whose gradient is infinite for equal extents. Of the gradient of
    the axes, only the part of the yaw is kept. It is damped if the horizontal extents are nearly equal.

    Args:
        features: Normalised features.
        existence_logit: Logits of the existence probabilities.
        proposals: Number of proposals per category of the layout.
        spec: Layout of the model.
        chosen: Scene and proposal of each object.

    Returns:
        Objects in the order of `chosen`.
    """
    scene, slot = chosen
    values = features[scene, slot].float()
    low, high = values.new_tensor(spec.feature_bounds.low), values.new_tensor(spec.feature_bounds.high)
    values = values * (high - low) + low
    lower = values.new_zeros(len(values), 3, 3)
    lower[:, TRIL[0], TRIL[1]] = values[:, 3:]
    scatter_m = lower @ lower.mT
    fixed = scatter_m.detach()
    is_finite = torch.isfinite(fixed).all(dim=2).all(dim=1)  # eigh raises an error for NaN.
    _, axes = torch.linalg.eigh(torch.where(is_finite[:, None, None], fixed, torch.eye(3, device=fixed.device)))
    up = axes[:, 2].abs().argmax(dim=1)
    order = torch.stack([(up + 1) % 3, (up + 2) % 3, up], dim=1)
    axes = torch.gather(axes, 2, order[:, None].expand(-1, 3, -1))
    double_yaw, turn_rad = _measure_yaw(scatter_m)
    size_m = torch.einsum("nki,nkl,nli->ni", axes, scatter_m, axes).clamp(min=MIN_EXTENT_M)
    # Rotation about z by a small angle, whose value is 0 and whose gradient is that of the yaw.
    turned = torch.stack([-axes[:, 1], axes[:, 0], torch.zeros_like(axes[:, 2])], dim=1)
    axes = axes + turn_rad[:, None, None] * turned
    category = _list_categories(proposals, spec, features.device)
    existence = existence_logit.detach().float()[scene, slot].sigmoid()
    return Objects(scene, category[slot], existence, values[:, :3], axes, size_m, double_yaw)


def _list_categories(proposals: Sequence[int], spec: LayoutSpec, device: torch.device) -> Int[Tensor, " proposals"]:
    """Return the category of each proposal, an index into CATEGORIES."""
    known = torch.tensor([CATEGORY_INDEX[name] for name in spec.categories], device=device)
    return known.repeat_interleave(torch.tensor(list(proposals), device=device))


def _measure_yaw(scatter_m: Float[Tensor, "n 3 3"]) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"]]:
    """Return cosine and sine of twice the yaw, and an angle (rad) of value 0 that has the gradient of the yaw."""
    across = scatter_m[:, 0, 0] - scatter_m[:, 1, 1], 2 * scatter_m[:, 0, 1]
    least = MIN_ELONGATION * (scatter_m[:, 0, 0] + scatter_m[:, 1, 1]).detach()
    double = torch.stack(across, dim=1)
    length = torch.linalg.vector_norm(double.detach(), dim=1).clamp(min=1e-9)
    unit = double.detach() / length[:, None]
    # Gradient of the unit vector: the part across it, divided by a length that is not too small.
    normal = torch.stack([-unit[:, 1], unit[:, 0]], dim=1)
    turn = (normal * double).sum(dim=1) / torch.maximum(length, least)
    turn = turn - turn.detach()
    return unit + turn[:, None] * normal, 0.5 * turn


# ----------------------------------------------------------------------------------------------------------- penalties


def compute_penetration(objects: Objects, scenes: int) -> Float[Tensor, " scenes"]:
    """Sum the horizontal penetration depths of pairs of objects that overlap vertically.

    The depth is the shortest horizontal displacement that separates the footprints, by the separating axis theorem.
    Each pair is weighted by the product of its existence probabilities. Pairs of TOUCHING_PAIRS have no penalty, and
    those of DEEP_PAIRS have a larger tolerance.

    Args:
        objects: Objects.
        scenes: Number of layouts.

    Returns:
        Sum of the depths beyond the tolerance (m).
    """
    tolerance_m = torch.from_numpy(PAIR_TOLERANCE_M).to(objects.center_m)
    i, j = _find_pairs(objects, torch.isfinite(tolerance_m))
    a, b = objects.take(i), objects.take(j)
    reach_m = ((box.axes[:, 2].detach().abs() * box.size_m.detach()).sum(dim=1) / 2 for box in (a, b))
    rise_m = (a.center_m[:, 2] - b.center_m[:, 2]).detach().abs()
    depth_m = -_separate_footprints(a, b) - tolerance_m[a.category, b.category]
    weight = a.existence * b.existence * (rise_m < sum(reach_m))
    return _sum_scenes(weight * depth_m.clamp(min=0), a.scene, scenes)


def compute_footprint(objects: Objects, ground: Ground) -> Float[Tensor, " scenes"]:
    """Sum the areas of buildings and walls on road and sidewalk, divided by the root of the area of the footprint.

    The unit is therefore a length. A square of side s that stands with half its area on the road has a penalty of s/2.

    Args:
        objects: Objects.
        ground: Ground.

    Returns:
        Sum of the intrusions (m).
    """
    allowed = {CATEGORY_INDEX[name]: area for name, area in SIDEWALK_TOLERANCE_M2.items()}
    some = objects.take(objects.is_any(tuple(allowed)))
    unit = torch.linspace(-0.5, 0.5, FOOTPRINT_POINTS, device=some.center_m.device)
    share = torch.ones_like(unit)
    share[[0, -1]] = 0.5  # Trapezoidal rule.
    points = torch.cartesian_prod(unit, unit)
    shares = torch.outer(share, share).flatten() / share.sum() ** 2
    sides_m = some.axes[:, :2, :2] * some.size_m[:, None, :2]
    xy_m = some.center_m[:, None, :2] + torch.einsum("nij,pj->npi", sides_m, points)
    inside = ground.contains(xy_m.detach())
    # The probability is a step, so its gradient is zero except at the border. The gradient is that of blurred maps.
    maps, blurred = ground.forbidden
    sharp = ground.sample(maps, some.scene, xy_m.detach()) * inside[:, None]
    smooth = ground.sample(blurred, some.scene, xy_m)
    found = sharp + torch.where(sharp > MIN_PROBABILITY, smooth - smooth.detach(), 0)
    footprint_m2 = (some.size_m[:, 0] * some.size_m[:, 1]).detach()
    area_m2 = (found * shares).sum(dim=2) * footprint_m2[:, None]
    tolerance_m2 = torch.tensor([allowed.get(k, 0.0) for k in range(len(CATEGORIES))], device=area_m2.device)
    excess_m2 = area_m2[:, 0] + (area_m2[:, 1] - tolerance_m2[some.category]).clamp(min=0)
    return _sum_scenes(some.existence * excess_m2 / footprint_m2.sqrt(), some.scene, len(ground.probability))


def _blur(maps: Float[Tensor, "b k rows cols"], resolution_m: float) -> Float[Tensor, "b k rows cols"]:
    """Apply a box filter of FOOTPRINT_BLUR_M twice; pixels outside the maps do not count."""
    reach = max(1, round(FOOTPRINT_BLUR_M / resolution_m / 2))
    for along, across in ((reach, 0), (0, reach)) * 2:
        kernel = 2 * along + 1, 2 * across + 1
        maps = F.avg_pool2d(maps, kernel, 1, (along, across), count_include_pad=False)
    return maps


def compute_height(objects: Objects, ground: Ground) -> Float[Tensor, " scenes"]:
    """Sum the distances of standing objects from the ground under their centres, beyond HEIGHT_TOLERANCE_M.

    Args:
        objects: Objects.
        ground: Ground.

    Returns:
        Sum of the distances (m). Objects without ground under their centre do not count.
    """
    allowed = {CATEGORY_INDEX[name]: both for name, both in HEIGHT_TOLERANCE_M.items()}
    some = objects.take(objects.is_any(tuple(allowed)))
    surface_m = ground.find_surface(some.scene, some.center_m[:, :2].detach())
    known = torch.isfinite(surface_m) & ground.contains(some.center_m[:, :2].detach())
    reach_m = (some.axes[:, 2].abs() * some.size_m).sum(dim=1) / 2
    gap_m = some.center_m[:, 2] - reach_m - surface_m.nan_to_num()
    limits_m = torch.tensor([allowed.get(k, (0.0, 0.0)) for k in range(len(CATEGORIES))], device=gap_m.device)
    below_m, above_m = limits_m[some.category].unbind(dim=1)
    excess_m = (gap_m - above_m).clamp(min=0) + (-gap_m - below_m).clamp(min=0)
    return _sum_scenes(some.existence * known * excess_m, some.scene, len(ground.probability))


def compute_support(objects: Objects, scenes: int) -> Float[Tensor, " scenes"]:
    """Sum the gaps between signs, lamps and signals and the nearest pole, wall or building, beyond SUPPORT_M.

    The gap is the separation of the boxes along their face normals, and a soft minimum is taken over the supporters.
    Supporters with a low existence probability count less.

    Args:
        objects: Objects.
        scenes: Number of layouts.

    Returns:
        Sum of the gaps (m). Signs without a supporter within SUPPORT_RANGE_M do not count.
    """
    sign, supporter = (
        torch.nonzero(objects.is_any(categories))[:, 0]
        for categories in ((CATEGORY_INDEX["traffic_control"],), SUPPORTERS)
    )
    i, j = torch.nonzero(objects.scene[sign, None] == objects.scene[supporter], as_tuple=True)
    a, b = objects.take(sign[i]), objects.take(supporter[j])
    gap_m = _separate_boxes(a, b).clamp(min=0)
    near = gap_m.detach() < SUPPORT_RANGE_M
    i, gap_m, existence = i[near], gap_m[near], b.existence[near]
    # Softmax over the supporters of each sign; the largest logit of the sign is subtracted against overflow.
    logit = existence.log() - gap_m.detach() / SUPPORT_SPREAD_M
    top = logit.new_full((len(sign),), -torch.inf).scatter_reduce(0, i, logit, "amax")
    weight = (logit - top[i]).exp()
    total = weight.new_zeros(len(sign)).index_add(0, i, weight)
    nearest_m = gap_m.new_zeros(len(sign)).index_add(0, i, weight * gap_m) / total.clamp(min=1e-9)
    some = objects.take(sign)
    return _sum_scenes(some.existence * (nearest_m - SUPPORT_M).clamp(min=0), some.scene, scenes)


def compute_heading(objects: Objects, ground: Ground) -> Float[Tensor, " scenes"]:
    """Sum the deviations of vehicles on the road from the direction of the road.

    The direction of the road is that in which the probability of road changes least, from the structure tensor in a
    window of LANE_WINDOW_M. Directions count modulo pi. Vehicles at junctions have no penalty (MIN_COHERENCE).

    Args:
        objects: Objects.
        ground: Ground.

    Returns:
        Sum of LANE_LENGTH_M * sin^2 of the angle, beyond LANE_TOLERANCE_RAD (m).
    """
    some = objects.take(objects.is_any(VEHICLES))
    with torch.no_grad():
        along, coherence, is_on_road = _measure_lanes(ground, some)
    cos = (along * some.double_yaw).sum(dim=1)
    deviation = (0.5 * (1 - cos) - np.sin(LANE_TOLERANCE_RAD) ** 2).clamp(min=0)
    weight = some.existence * is_on_road * (coherence > MIN_COHERENCE)
    return _sum_scenes(weight * LANE_LENGTH_M * deviation, some.scene, len(ground.probability))


def compute_alignment(objects: Objects, ground: Ground) -> Float[Tensor, " scenes"]:
    """Sum the deviations of buildings, walls and vehicles from the direction of the nearest edge of the road.

    Directions count modulo pi / 2: an object may be parallel or perpendicular to the edge.

    Args:
        objects: Objects.
        ground: Ground.

    Returns:
        Sum of ALIGNMENT_LENGTH_M * sin^2 of twice the angle, beyond ALIGNMENT_TOLERANCE_RAD (m).
    """
    some = objects.take(objects.is_any([CATEGORY_INDEX[name] for name in ALIGNED]))
    with torch.no_grad():
        along, distance_m = ground.edges
        grid, (rows, cols) = ground.spec.grid, along.shape[2:]
        x_m, y_m = some.center_m[:, :2].unbind(dim=1)
        row = ((grid.front_m - x_m) / (grid.front_m - grid.back_m) * rows).long().clamp(0, rows - 1)
        col = ((grid.left_m - y_m) / (grid.left_m - grid.right_m) * cols).long().clamp(0, cols - 1)
        edge, far_m = along[some.scene, :, row, col], distance_m[some.scene, 0, row, col]
    cos = (edge * some.double_yaw).sum(dim=1)
    deviation = (1 - cos.square() - np.sin(2 * ALIGNMENT_TOLERANCE_RAD) ** 2).clamp(min=0)
    weight = some.existence * (far_m < EDGE_RANGE_M)
    return _sum_scenes(weight * ALIGNMENT_LENGTH_M * deviation, some.scene, len(ground.probability))


def _measure_lanes(ground: Ground, objects: Objects) -> tuple[Tensor, Tensor, Tensor]:
    """Return the direction (n, 2) of the road as cosine and sine of the doubled angle, its coherence, and "on road"."""
    center_m = objects.center_m[:, :2]
    unit = torch.linspace(-LANE_WINDOW_M, LANE_WINDOW_M, LANE_SAMPLES, device=center_m.device)
    offset_m = torch.cartesian_prod(unit, unit)
    xy_m = center_m[:, None] + offset_m
    found = ground.sample(ground.slopes, objects.scene, xy_m)
    weight = torch.exp(-0.5 * (offset_m / LANE_SPREAD_M).square().sum(dim=1)) * ground.contains(xy_m)
    across_cos, across_sin, trace = (found * weight[:, None]).sum(dim=2).unbind(dim=1)
    length = torch.hypot(across_cos, across_sin)
    along = -torch.stack([across_cos, across_sin], dim=1) / length.clamp(min=1e-9)[:, None]
    road = ground.sample(ground.road[:, None], objects.scene, center_m[:, None])[:, 0, 0]
    return along, length / trace.clamp(min=1e-3), (road > 0.5) & ground.contains(center_m)


def compute_penalties(objects: Objects, ground: Ground, names: Sequence[str]) -> dict[str, Float[Tensor, " scenes"]]:
    """Compute penalties of layouts.

    Args:
        objects: Objects of the layouts.
        ground: Ground of the layouts.
        names: Names of penalties, keys of CONSTRAINTS.

    Returns:
        Penalty (m) of each layout, by name.
    """
    scenes = len(ground.probability)
    compute = {
        "penetration": lambda: compute_penetration(objects, scenes),
        "footprint": lambda: compute_footprint(objects, ground),
        "height": lambda: compute_height(objects, ground),
        "support": lambda: compute_support(objects, scenes),
        "heading": lambda: compute_heading(objects, ground),
        "alignment": lambda: compute_alignment(objects, ground),
    }
    return {name: compute[name]() for name in names}


def sum_penalties(penalties: Mapping[str, Tensor], weights: Mapping[str, float]) -> Float[Tensor, " scenes"]:
    """Return the weighted sum of penalties.

    Args:
        penalties: Penalty (m) of each layout, by name.
        weights: Weight of each penalty; a missing weight is 1.

    Returns:
        Sum (m) of each layout.
    """
    return torch.stack([weights.get(name, 1.0) * value for name, value in penalties.items()]).sum(dim=0)


# ------------------------------------------------------------------------------------------------------------- helpers


def _list_pair_tolerances() -> np.ndarray:
    """Return the depth (m) up to which the overlap of two categories has no penalty, (11, 11); infinite if exempt."""
    solid = np.array([index not in VEGETATION for index in range(len(CATEGORIES))])
    table_m = np.where(solid[:, None] & solid, PENETRATION_TOLERANCE_M, np.inf)
    for (first, second), depth_m in (dict.fromkeys(TOUCHING_PAIRS, np.inf) | DEEP_PAIRS).items():
        a, b = CATEGORY_INDEX[first], CATEGORY_INDEX[second]
        table_m[a, b] = table_m[b, a] = depth_m
    return table_m


PAIR_TOLERANCE_M = _list_pair_tolerances()  # (11, 11); infinite for exempt pairs.


def _find_pairs(objects: Objects, table: Bool[Tensor, "11 11"]) -> tuple[Tensor, Tensor]:
    """Return the pairs i < j of one layout that the table selects and whose bounding circles overlap."""
    center_m, size_m = objects.center_m.detach(), objects.size_m.detach()
    radius_m = size_m[:, :2].square().sum(dim=1).sqrt() / 2
    far_m = torch.cdist(center_m[:, :2], center_m[:, :2])
    near = (objects.scene[:, None] == objects.scene) & (far_m < radius_m[:, None] + radius_m)
    near &= table.to(near.device)[objects.category[:, None], objects.category]
    i, j = torch.nonzero(near.triu(1), as_tuple=True)
    return i, j


def _separate_footprints(a: Objects, b: Objects) -> Float[Tensor, " n"]:
    """Return the signed horizontal separation of pairs (m): the largest over the face normals of both footprints."""
    normals = torch.cat([_normalise(box.axes[:, :2, :2].mT) for box in (a, b)], dim=1)  # (n, 4, 2)
    apart_m = (normals @ (b.center_m - a.center_m)[:, :2, None])[..., 0].abs()
    return (apart_m - sum(_measure_reach(normals, box, 2) for box in (a, b))).amax(dim=1)


def _separate_boxes(a: Objects, b: Objects) -> Float[Tensor, " n"]:
    """Return the signed separation of pairs (m): the largest over the face normals of both boxes."""
    normals = torch.cat([_normalise(box.axes.mT) for box in (a, b)], dim=1)  # (n, 6, 3)
    apart_m = (normals @ (b.center_m - a.center_m)[..., None])[..., 0].abs()
    return (apart_m - sum(_measure_reach(normals, box, 3) for box in (a, b))).amax(dim=1)


def _measure_reach(normals: Float[Tensor, "n k d"], box: Objects, d: int) -> Float[Tensor, "n k"]:
    """Return the extent of boxes along normals in d dimensions, from the centre; for ellipsoids, that of the ball."""
    part = (normals @ box.axes[:, :d]) * box.size_m[:, None] / 2
    ball = torch.sqrt(part.square().sum(dim=2) + 1e-12)
    return torch.where((box.category == ELLIPSOID)[:, None], ball, part.abs().sum(dim=2))


def _normalise(vectors: Float[Tensor, "n k d"]) -> Float[Tensor, "n k d"]:
    return vectors / vectors.detach().norm(dim=2, keepdim=True).clamp(min=1e-9)


def _sum_scenes(values: Float[Tensor, " n"], scene: Int[Tensor, " n"], scenes: int) -> Float[Tensor, " scenes"]:
    return values.new_zeros(scenes).index_add(0, scene, values)
