"""Measured spectra: which are read, and how they come to the grid on which the simulation works."""
