"""Is the lab ready for a session: a verdict on each of exposure, light, optics, print, sensor and supplies."""
