"""Measure light from raw counts: dark frames, primaries, lamp drift, linearity and noise."""
