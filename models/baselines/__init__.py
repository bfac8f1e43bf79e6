"""Voxel methods with which the paper compares: SemCity, PDD and XCube, each with the interface of base.py."""
