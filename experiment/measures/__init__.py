"""Measurements on frames: exposure, sensor, light and print, and the fits for them."""
