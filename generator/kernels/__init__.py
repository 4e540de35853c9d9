"""Compiled functions that draw a sample of the look-up table for each pixel of a source image."""
