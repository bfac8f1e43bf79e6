"""Scenes composed from known and generated parts: inpainting, outpainting, extension, seams."""
