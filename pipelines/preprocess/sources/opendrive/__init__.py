"""Reader of ASAM OpenDRIVE files."""
