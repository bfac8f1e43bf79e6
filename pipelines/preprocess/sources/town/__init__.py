"""The procedural town, the built-in data source."""
