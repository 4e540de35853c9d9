"""Simulated projectors and screens with their protocols."""
