"""Check a rig before a session: verdicts on exposure, light, optics, print, sensor and supplies."""
