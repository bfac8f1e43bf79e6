"""Reader of extracts of OpenStreetMap."""
