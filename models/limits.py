"""Limits on the sizes that untrusted files can state, so that a small file cannot exhaust the memory.

Readers call `require_within` before they allocate memory for a number that a file states. The environment variable
PRITTI_MAX_<NAME> replaces a limit, for example PRITTI_MAX_RASTER_PIXELS=1000000000; workers of Ray on other nodes need
it in their runtime environment. SECURITY.md lists the limits.
"""

from __future__ import annotations

import os
from typing import NamedTuple

PREFIX = "PRITTI_MAX_"


class LimitError(ValueError):
    """Raised if a number exceeds a limit."""


class Limit(NamedTuple):
    """A limit.

    Attributes:
        value: Largest accepted number.
        meaning: What is counted, for error messages and SECURITY.md.
    """

    value: int
    meaning: str


LIMITS = {
    "raster_pixels": Limit(2**26, "pixels of all ground classes of a scene"),
    "scene_primitives": Limit(200_000, "primitives of a scene"),
    "scene_coverage": Limit(2**29, "pixels visited to rasterise the ground polygons or triangles of a scene"),
    "scene_voxels": Limit(2**28, "voxels of a scene"),
    "table_rows": Limit(2_000_000, "rows, objects or list entries of a file"),
    "table_bytes": Limit(2**29, "estimated bytes in memory of the columns that are read from a table file"),
    "text_characters": Limit(1_000, "characters of an id, a label or a name"),
    "polygon_points": Limit(10_000, "points of a polygon"),
    "map_bytes": Limit(2**30, "bytes of an extract of OpenStreetMap"),
    "map_features": Limit(2_000_000, "features with tags in an extract of OpenStreetMap"),
    "json_bytes": Limit(2**28, "bytes of a JSON or XML file, after decompression"),
    "json_values": Limit(2**23, "commas, colons and opening brackets of a JSON text"),
    "glb_bytes": Limit(2**28, "bytes of a GLB file"),
    "glb_nodes": Limit(200_000, "nodes of a GLB file"),
    "glb_placements": Limit(100_000, "mesh primitives of a GLB file, counted once per node that places them"),
    "glb_vertices": Limit(3_000_000, "vertices and triangle corners of a GLB file"),
    "glb_ellipsoids": Limit(20_000, "ellipsoids that must be fitted to vertices of a GLB file"),
    "array_bytes": Limit(2**28, "bytes of an array or of a batch of pictures in an .npz file, after decompression"),
    "copied_bytes": Limit(2**35, "bytes of a file that is copied from object storage to this machine"),
    "model_parameters": Limit(2_000_000_000, "parameters of a network"),
    "model_buffers": Limit(2**24, "entries of the buffers of a network, such as position embeddings"),
    "model_timesteps": Limit(100_000, "training timesteps of a noise schedule"),
}


def find_limit(name: str) -> int:
    """Return a limit, or the value of its environment variable.

    Args:
        name: Key of LIMITS.

    Returns:
        Largest accepted number.

    Raises:
        ValueError: The environment variable is not a positive integer.
    """
    variable = PREFIX + name.upper()
    text = os.environ.get(variable, "")
    if not text:
        return LIMITS[name].value
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"{variable} is {text!r}, expected a positive integer")
    return int(text)


def require_within(name: str, number: float, place: str = "", is_partial: bool = False) -> None:
    """Raise an error if a number exceeds a limit.

    Args:
        name: Key of LIMITS.
        number: Number that a file states or that follows from it.
        place: File, row or scene, for the message.
        is_partial: Whether the count stopped at `number`, so there may be more.

    Raises:
        LimitError: The number exceeds the limit. The message names the number, the limit and the environment variable
            that raises it.
    """
    limit = find_limit(name)
    if not number <= limit:
        number = min(number, 10**30) if isinstance(number, int) else number  # Longer integers are not readable.
        plain = f"{number:.0f}" if isinstance(number, float) else str(number)
        raise LimitError(
            f"{place + ': ' if place else ''}{'at least ' * is_partial}{number:,} {LIMITS[name].meaning}; at most"
            f" {limit:,} are accepted. If the file can be trusted, set {PREFIX}{name.upper()}={plain}"
            f"{' or more' * is_partial} to raise the limit"
        )
