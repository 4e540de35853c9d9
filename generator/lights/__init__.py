"""Illuminants of images: those of the LUT, mixtures of them, and how they are chosen."""
