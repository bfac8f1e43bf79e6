"""Noise schedule, samplers and RePaint."""
