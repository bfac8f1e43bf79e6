"""The studio: sessions, HTTP interface and Ray Serve deployment."""
