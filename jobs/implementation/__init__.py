"""Implementations of the executables in jobs/; they are imported after the command line is parsed."""
