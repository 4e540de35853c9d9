"""Drivers of cameras, projectors and displays, and readers of raw files; these modules import only `foundation`."""
