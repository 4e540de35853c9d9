"""Check a laboratory before a session: exposure, light, optics, print, sensor and supplies."""
