"""Executables, one file per job, with their implementations and shared modules."""
