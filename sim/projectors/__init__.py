"""Simulated projectors with their control protocols, and light from real screens."""
