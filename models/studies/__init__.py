"""Experiments on parts of the model that are not part of the pipeline."""
