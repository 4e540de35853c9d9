"""Raw files of cameras: unprocessed counts, black level, active area."""
