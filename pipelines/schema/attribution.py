"""Licence notices of data sources, for dataset.json, the column `attribution` and exports."""

from __future__ import annotations

# Sources whose licences demand a notice.
ATTRIBUTIONS = {
    "osm": "© OpenStreetMap contributors, ODbL 1.0 (https://www.openstreetmap.org/copyright)",
    "kitti360": "KITTI-360, CC BY-NC-SA 3.0 (https://www.cvlibs.net/datasets/kitti-360)",
    "av2": "Argoverse 2, CC BY-NC-SA 4.0 (https://www.argoverse.org/av2.html)",
}


def find_attribution(source: str) -> str | None:
    """Return the licence notice of a source.

    Args:
        source: Value of the source column.

    Returns:
        Notice; None if the source demands none.
    """
    return ATTRIBUTIONS.get(source)
