"""Readers of raw drives, with one module or package per dataset."""
