"""Exact geometry of boxes: IoU3D, the Cholesky parametrisation and other encodings."""
