"""Compiled kernels that convert source codes to samples, and their arithmetic."""
