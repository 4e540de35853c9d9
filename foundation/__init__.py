"""Common functions of all packages: errors, clocks, command line, files and folders, HTML pages, plots, colorimetry."""
