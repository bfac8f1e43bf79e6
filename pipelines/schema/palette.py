"""Colours and class ids of the authors' renderings, keyed by category and ground class.

A class id names either a ground class or a primitive category. One small integer therefore describes the class of a
pixel, triangle or voxel. The authors' data contain no crossings. This project adds id 17 and a colour for crossings.
"""

from __future__ import annotations

import numpy as np

from models.scene import CATEGORIES, GROUND_CLASSES, Scene
from models.voxel_grids import EMPTY as EMPTY

GROUND_CLASS_ID = {"ground": 1, "terrain": 2, "sidewalk": 3, "parking": 4, "road": 5, "crossing": 17}
CATEGORY_CLASS_ID = {name: 6 + index for index, name in enumerate(CATEGORIES)}
CLASS_ID = GROUND_CLASS_ID | CATEGORY_CLASS_ID

COLOR_HEX = {
    "ground": "510051",
    "terrain": "98fb98",
    "sidewalk": "f423e8",
    "parking": "faaaa0",
    "road": "804080",
    "crossing": "c8a0d8",
    "vegetation_cuboid": "6b8e23",
    "vegetation_ellipsoid": "6b8e23",
    "vehicle_big": "003c64",
    "vehicle_small": "00008e",
    "two_wheelers": "770b20",
    "human": "dc143c",
    "construction_big": "464646",
    "construction_small": "66669c",
    "pole": "999999",
    "traffic_control": "faaa1e",
    "object": "0080c0",
}
EMPTY_HEX = "ffffff"


def parse_rgb(color_hex: str) -> tuple[int, int, int]:
    """Parse a hexadecimal colour.

    Args:
        color_hex: Six hexadecimal digits, such as "804080".

    Returns:
        (red, green, blue) in sRGB, each in 0..255.
    """
    red, green, blue = bytes.fromhex(color_hex)
    return red, green, blue


def _list_colors_by_class_id() -> np.ndarray:
    colors = np.zeros((max(CLASS_ID.values()) + 1, 3), np.uint8)
    colors[EMPTY] = parse_rgb(EMPTY_HEX)
    for name, class_id in CLASS_ID.items():
        colors[class_id] = parse_rgb(COLOR_HEX[name])
    return colors


CLASS_COLORS = _list_colors_by_class_id()  # (18, 3) uint8 sRGB; row k is the colour of class id k; EMPTY is white.
CATEGORY_IDS = np.array([CATEGORY_CLASS_ID[name] for name in CATEGORIES], np.uint8)  # (11,) class id of each category.

assert set(GROUND_CLASS_ID) == set(GROUND_CLASSES) and set(COLOR_HEX) == set(CLASS_ID)


def list_ground_ids(scene: Scene) -> np.ndarray:
    """Return the class ids of a scene's ground classes.

    Args:
        scene: Scene with G ground classes.

    Returns:
        (G + 1,) class ids. The last entry is EMPTY; index -1 (no ground) therefore selects EMPTY.
    """
    return np.array([GROUND_CLASS_ID[name] for name in scene.ground_classes] + [EMPTY], np.uint8)
