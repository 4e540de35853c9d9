"""Random differences between images: exposure, uneven light, and the noise of a higher ISO speed."""
