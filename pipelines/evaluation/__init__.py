"""Scores of datasets, reconstructions, seams and samplers."""
