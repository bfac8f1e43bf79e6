"""Render images of scenes from above and from street level."""
