"""Simulated camera: raw files, and a Canon EOS that uses PTP."""
