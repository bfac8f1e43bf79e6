"""Batches and latents for training."""
