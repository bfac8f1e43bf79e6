"""Edits and repair of single scenes."""
