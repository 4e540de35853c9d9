"""Basics for all packages: errors, clocks, command line, atomic files and folders, pages, plots, colorimetry."""
