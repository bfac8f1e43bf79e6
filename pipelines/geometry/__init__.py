"""Geometry of whole scenes: rasterisation, voxels, road centrelines and shape fitting."""
