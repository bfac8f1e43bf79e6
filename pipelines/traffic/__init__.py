"""Simulate traffic on the streets of scenes with SUMO."""
