"""Simulated laboratory: projector, chart and camera in software, connected to the real drivers."""
