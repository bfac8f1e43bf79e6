"""Readers of raw drives, one module or package per dataset."""
