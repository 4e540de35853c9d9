"""Simulated room: print, light, lens, sensor and disturbances."""
