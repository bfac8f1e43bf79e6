"""Version 2 of the procedural town."""
