"""Extracts of OpenStreetMap that tests write, in metres around a point."""

from pathlib import Path

import pyproj

from pipelines.preprocess.sources.osm.extract import Region

LATITUDE, LONGITUDE = 52.0, 13.0
HERE = Region(origin_deg=(LATITUDE, LONGITUDE), radius_m=300.0)
PROJECT = pyproj.Proj(f"+proj=tmerc +lat_0={LATITUDE} +lon_0={LONGITUDE} +k=1 +ellps=WGS84")
STREET = {"highway": "residential", "width": "6", "sidewalk": "no"}


class Map:
    """An extract that a test writes, in metres around LATITUDE and LONGITUDE."""

    def __init__(self) -> None:
        self.nodes: dict[tuple[float, float], tuple[int, dict]] = {}
        self.ways: list[str] = []

    def node(self, x: float, y: float, **tags: str) -> int:
        number, known = self.nodes.get((x, y), (len(self.nodes) + 1, {}))
        self.nodes[x, y] = (number, known | tags)
        return number

    def way(self, points: list[tuple[float, float]], **tags: str) -> None:
        refs = "".join(f'<nd ref="{self.node(*point)}"/>' for point in points)
        self.ways.append(f'<way id="{1000 + len(self.ways)}" version="1">{refs}{format_tags(tags)}</way>')

    def text(self) -> str:
        lines = []
        for (x, y), (number, tags) in self.nodes.items():
            longitude, latitude = PROJECT(x, y, inverse=True)
            place = f'lat="{latitude:.9f}" lon="{longitude:.9f}"'
            lines.append(f'<node id="{number}" version="1" {place}>{format_tags(tags)}</node>')
        return f'<osm version="0.6">{"".join(lines)}{"".join(self.ways)}</osm>'

    def write(self, path: Path) -> str:
        path.write_text(self.text())
        return str(path)


def format_tags(tags: dict[str, str]) -> str:
    return "".join(f'<tag k="{key.replace("__", ":")}" v="{value}"/>' for key, value in tags.items())


def make_street(**tags: str) -> Map:
    made = Map()
    made.way([(-200.0, 0.0), (0.0, 0.0), (200.0, 0.0)], **STREET | tags)
    return made


def make_town_street() -> Map:
    """Return a street between two rows of houses."""
    made = Map()
    made.way([(-200.0, 0.0), (200.0, 0.0)], highway="residential", width="7")
    for k in range(-10, 10):
        for y in (12.0, -24.0):
            x = 20.0 * k
            made.way([(x, y), (x + 14, y), (x + 14, y + 12), (x, y + 12), (x, y)], building="house")
    return made
