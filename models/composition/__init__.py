"""Combine known and generated regions of scenes: inpainting, outpainting, extension and seams."""
