"""Exact box geometry: IoU3D, Cholesky parameters and other encodings."""
