"""Figures: measured properties of a session or LUT, with limits. `figure` has their type, `all_figures` their list."""
