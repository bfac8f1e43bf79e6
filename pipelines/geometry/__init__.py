"""Geometry of whole scenes: rasterisation, voxels, centrelines, shape fitting."""
