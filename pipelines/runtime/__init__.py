"""Storage, provenance and Ray task helpers."""
