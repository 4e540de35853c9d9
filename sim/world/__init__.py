"""The simulated room: print, light, lens and sensor noise."""
