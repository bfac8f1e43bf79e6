"""Reference surfaces of ground heights: the surface on which objects stand, or the top of slabs above it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from models.layout import SLAB_OFFSET_M, LayoutSpec
from models.scene import Scene

# Per source, the surface to which the ground heights refer. "surface" is the surface on which objects stand.
# "top" is the top of the ground slabs, 0.3 m above that surface.
SURFACE = {"town": "top", "kitti360": "top"} | dict.fromkeys(("av2", "osm", "opendrive", "own", "py123d"), "surface")


def find_surface(source: str, scene_id: str, default: str) -> str:
    """Return the surface to which the ground heights of a scene refer.

    Args:
        source: Source of the scene.
        scene_id: Id of the scene. Edited scenes keep the id of the scene that was edited, which begins with its source.
        default: Surface of other scenes, such as generated ones.

    Returns:
        "top" or "surface" (SURFACE).
    """
    return SURFACE.get(source) or SURFACE.get(scene_id.partition("-")[0], default)


def find_surface_offset(surface: str, spec: LayoutSpec) -> float:
    """Return the height of the reference surface of a model above another surface.

    Args:
        surface: "top" or "surface".
        spec: Layout of the model.

    Returns:
        Height (m).
    """
    return spec.slab_offset_m - (SLAB_OFFSET_M if surface == "top" else 0.0)


def to_model_surface(scene: Scene, spec: LayoutSpec) -> Scene:
    """Convert the ground heights of a real scene to the reference surface of the model (`LayoutSpec.surface`).

    Args:
        scene: Scene. The heights of generated scenes are not changed, because they have the surface of their model.
        spec: Layout of the model.

    Returns:
        The same scene, or a scene whose ground is higher or lower by SLAB_OFFSET_M.
    """
    return _raise_ground(scene, find_surface_offset(find_surface(scene.source, scene.scene_id, spec.surface), spec))


def from_model_surface(scene: Scene, given: Scene, spec: LayoutSpec) -> Scene:
    """Convert the ground heights of a generated scene to the reference surface of its input.

    Args:
        scene: Scene.
        given: Scene from which it was generated.
        spec: Layout of the model.

    Returns:
        The scene.
    """
    return _raise_ground(scene, -find_surface_offset(find_surface(given.source, given.scene_id, spec.surface), spec))


def _raise_ground(scene: Scene, offset_m: float) -> Scene:
    return replace(scene, height_m=scene.height_m + np.float32(offset_m) * scene.occupied) if offset_m else scene
