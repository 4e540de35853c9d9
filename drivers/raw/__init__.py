"""Raw files of cameras: unprocessed photosites, black level, active area."""
