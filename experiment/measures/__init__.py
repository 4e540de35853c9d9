"""Measurements of frames: sensor, light, print, robust fits and smooth fields."""
