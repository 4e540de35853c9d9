"""The printed chart: contents, layout, and the files for a print shop."""
