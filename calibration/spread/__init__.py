"""Measurement and correction of light that the lens scatters onto patches."""
