"""TIFF containers: directories and tags, read and written."""
