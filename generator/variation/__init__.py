"""Variation between images besides scene and illuminant: exposure, uneven light, noise of another ISO speed."""
