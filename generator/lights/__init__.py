"""Illuminants of images: illuminants of the look-up table (LUT) or mixtures of them, and their choice."""
