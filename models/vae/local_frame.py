"""The local frame: yaw relative to the streets, and height relative to the ground, around each primitive.

Buildings, walls, parked cars and signs are parallel or perpendicular to the street, in whatever direction it runs, and
they stand on the ground, whatever its height. In the local frame, the yaw and the height of such an object are
constants. A diffusion model therefore need not relate object latents and ground latents to align objects with streets
or to put them on the ground. The paper encodes both in the scene frame.

The direction of the streets at a point is the mean direction of the edges of the road, with weights that fall with the
distance. It is a line, so opposite directions are equal; Cholesky parameters do not distinguish them either. The height
of the ground is a mean with the same weights.

Where two perpendicular streets are equally near, the direction is not continuous. An object at such a place may be
decoded with another yaw if the decoded ground differs slightly from the true ground.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from models.layout import FEATURES, LayoutSpec
from models.scene import ROAD_CLASSES, Grid

FINE_PIXEL_M, COARSE_PIXEL_M = 0.5, 1.0  # Pixels of the slopes and of the fields; rasters may be coarser.
BLUR_M = 2.5  # Width of the box filter that smooths the road; it is applied twice. It is at least three pixels.
NEAR_M = 1.0  # Weights do not increase further below this distance.


def compute_edge_directions(road: Bool[Tensor, "b rows cols"], resolution_m: float) -> Float[Tensor, "b 2 rows2 cols2"]:
    """Compute the directions of the edges of the road.

    Args:
        road: Road of each scene; rows run against x and columns against y.
        resolution_m: Side of a pixel.

    Returns:
        Cosine and sine of twice the yaw of the edge, times the squared slope of the smoothed road, in pixels of
        COARSE_PIXEL_M.
    """
    factor = find_pooling_factor(road.shape[1:], FINE_PIXEL_M / resolution_m)
    smooth, pixel_m = F.avg_pool2d(road.float()[:, None], factor), factor * resolution_m
    reach = max(1, round((BLUR_M / pixel_m - 1) / 2))
    for _ in range(2):
        smooth = F.avg_pool2d(smooth, 2 * reach + 1, 1, reach, count_include_pad=False)
    dx = smooth[:, 0, :-2, 1:-1] - smooth[:, 0, 2:, 1:-1]
    dy = smooth[:, 0, 1:-1, :-2] - smooth[:, 0, 1:-1, 2:]
    # The edge is perpendicular to the slope, so twice its yaw has the opposite cosine and sine.
    edges = torch.stack([dy * dy - dx * dx, -2 * dx * dy], dim=1)
    # Near the border, the filter sees only one side, so slopes are wrong.
    margin = min(2 * reach, edges.shape[2] // 4, edges.shape[3] // 4)
    edges = edges[:, :, margin : edges.shape[2] - margin, margin : edges.shape[3] - margin]
    edges = F.pad(edges, (margin + 1,) * 4)
    return F.avg_pool2d(edges, find_pooling_factor(edges.shape[2:], COARSE_PIXEL_M / pixel_m))


def find_pooling_factor(shape: Sequence[int], ratio: float) -> int:
    """Return the largest whole number up to a ratio that divides both sides of a raster.

    Args:
        shape: Numbers of rows and columns.
        ratio: Wanted factor.

    Returns:
        Factor, at least 1.
    """
    return max(k for k in range(1, max(1, round(ratio)) + 1) if not any(side % k for side in shape))


def sum_weighted(values: Float[Tensor, "b k rows cols"], pixel_m: float) -> Float[Tensor, "b k rows cols"]:
    """Sum values over all pixels, with the weights 1 / (d^2 + NEAR_M^2)^2 at the distance d.

    Args:
        values: Values to sum.
        pixel_m: Side of a pixel.

    Returns:
        Weighted sum at each pixel, in float64 because weights differ by a factor of 10^8.
    """
    rows, cols = values.shape[2:]
    row, col = (torch.arange(1 - n, n, device=values.device, dtype=torch.float64) * pixel_m for n in (rows, cols))
    weight = (row[:, None] ** 2 + col**2 + NEAR_M**2) ** -2
    padded = 2 * rows, 2 * cols
    product = torch.fft.rfft2(values.double(), padded) * torch.fft.rfft2(weight, padded)
    # The sum at pixel i is that of values[j] weight[i - j + rows - 1] over pixels j, entry i + rows - 1 of the product.
    return torch.fft.irfft2(product, padded)[:, :, rows - 1 : 2 * rows - 1, cols - 1 : 2 * cols - 1]


def locate_in_raster(xy_m: Float[Tensor, "*batch 2"], grid: Grid) -> Float[Tensor, "*batch 2"]:
    """Convert positions to the coordinates of `torch.nn.functional.grid_sample`.

    Args:
        xy_m: Positions in the scene frame.
        grid: Area of the raster.

    Returns:
        Column and row; -1 and 1 are the borders of the raster.
    """
    row = 2 * (grid.front_m - xy_m[..., 0]) / (grid.front_m - grid.back_m) - 1
    col = 2 * (grid.left_m - xy_m[..., 1]) / (grid.left_m - grid.right_m) - 1
    return torch.stack([col, row], dim=-1)


def sample_field(
    field: Float[Tensor, "b k rows cols"], xy_m: Float[Tensor, "b n 2"], grid: Grid
) -> Float[Tensor, "b k n"]:
    """Interpolate a field at points.

    Args:
        field: Values per pixel.
        xy_m: Points in the scene frame; those outside the grid get the value at its border.
        grid: Area of the field.

    Returns:
        Values at the points.
    """
    place = locate_in_raster(xy_m, grid)[:, None].to(field.dtype)
    return F.grid_sample(field, place, padding_mode="border", align_corners=False)[:, :, 0]


def rotate_cholesky(
    parameters: Float[Tensor, "*batch 6"], yaw_rad: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 6"]:
    """Rotate primitives about the vertical axis.

    The rotated factor R L is not triangular. A rotation Q of its first two columns makes it triangular, and
    (R L Q) (R L Q)^T = R S R^T.

    Args:
        parameters: Cholesky parameters (geometry/cholesky.py).
        yaw_rad: Angles.

    Returns:
        Cholesky parameters of the rotated primitives.
    """
    l00, l10, l11, l20, l21, l22 = parameters.unbind(-1)
    cos, sin = yaw_rad.cos(), yaw_rad.sin()
    a, b = cos * l00 - sin * l10, -sin * l11  # First row of R L.
    c, d = sin * l00 + cos * l10, cos * l11  # Second row.
    length = torch.hypot(a, b).clamp(min=1e-6)
    p, q = a / length, b / length
    return torch.stack([length, c * p + d * q, d * p - c * q, l20 * p + l21 * q, l21 * p - l20 * q, l22], dim=-1)


class LocalFrame:
    """Convert normalised features between the scene frame and the local frame.

    Args:
        spec: Layout of the scenes, which defines bounds, grid and ground classes.

    Raises:
        ValueError: The layout has no road.
    """

    def __init__(self, spec: LayoutSpec) -> None:
        self.spec = spec
        self.road = [spec.ground_classes.index(name) for name in ROAD_CLASSES if name in spec.ground_classes]
        if not self.road:
            raise ValueError(f"local_frame: the ground classes {spec.ground_classes} contain no {ROAD_CLASSES[0]}")

    def compute_field(
        self, height: Float[Tensor, "b ground rows cols"], occupied: Bool[Tensor, "b ground rows cols"]
    ) -> Float[Tensor, "b 3 rows2 cols2"]:
        """Compute the direction of the streets and the height of the ground.

        Args:
            height: Normalised heights.
            occupied: Ground masks.

        Returns:
            Cosine and sine of twice the yaw of the streets, times a positive weight (0 without edges), and the
            normalised height (0.5 without ground).
        """
        with torch.no_grad(), torch.autocast(height.device.type, enabled=False):
            grid, rows = self.spec.grid, occupied.shape[2]
            if not len(occupied):
                return height.new_full((0, 3, 1, 1), 0.5, dtype=torch.float64)
            resolution_m = grid.rows * grid.resolution_m / rows
            edges = compute_edge_directions(occupied[:, self.road].any(dim=1), resolution_m)
            factor = rows // edges.shape[2]
            mask = occupied.float()
            ground = torch.stack([(mask * height.float()).sum(dim=1), mask.sum(dim=1)], dim=1)
            values = torch.cat([edges, F.avg_pool2d(ground, factor)], dim=1)
            cos, sin, total, weight = sum_weighted(values, factor * resolution_m).unbind(1)
            found = torch.where(weight > 1e-9, total / weight, 0.5)
            return torch.stack([cos, sin, found], dim=1)

    def to_local(
        self, features: Float[Tensor, "b n 9"], field: Float[Tensor, "b 3 rows cols"]
    ) -> Float[Tensor, "b n 9"]:
        """Convert normalised features from the scene frame to the local frame.

        Args:
            features: Normalised features.
            field: Output of `compute_field`.

        Returns:
            Features with the same x and y, clipped to [0, 1].
        """
        return self._convert(features, field, -1.0).clamp(0, 1)

    def to_scene(
        self, features: Float[Tensor, "b n 9"], field: Float[Tensor, "b 3 rows cols"]
    ) -> Float[Tensor, "b n 9"]:
        """Convert normalised features from the local frame to the scene frame.

        Args:
            features: Normalised features.
            field: Output of `compute_field`.

        Returns:
            Features with the same x and y.
        """
        return self._convert(features, field, 1.0)

    def _convert(self, features: Tensor, field: Tensor, sign: float) -> Tensor:
        spec = self.spec
        with torch.autocast(features.device.type, enabled=False):
            values = features.float()
            low, high = values.new_tensor(spec.feature_bounds.low), values.new_tensor(spec.feature_bounds.high)
            values = values * (high - low) + low
            found = sample_field(field, values[..., :2].detach(), spec.grid)
            yaw_rad = (0.5 * torch.atan2(found[:, 1], found[:, 0])).float()
            # Heights are relative to the middle of their bounds, so z keeps its bounds.
            bottom, top = spec.height_bounds_m.low[0], spec.height_bounds_m.high[0]
            height_m = ((found[:, 2] - 0.5) * (top - bottom)).float()
            z_m = values[..., 2] + sign * height_m
            changed = torch.cat([z_m[..., None], rotate_cholesky(values[..., 3:FEATURES], sign * yaw_rad)], dim=-1)
            return torch.cat([features[..., :2].float(), (changed - low[2:]) / (high - low)[2:]], dim=-1)
