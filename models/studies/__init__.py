"""Experiments on single components of the models."""
