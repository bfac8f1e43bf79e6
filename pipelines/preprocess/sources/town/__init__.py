"""The procedural town."""
