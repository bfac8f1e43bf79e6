"""Implementations of the executables in jobs/, imported after the command line has been parsed."""
