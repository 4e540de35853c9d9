"""Readers of raw files: unprocessed counts, black level, visible area."""
