"""The printed chart: its layout, its data, and the files for the print shop."""
