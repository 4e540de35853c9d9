"""Checks of single frames, of stray light, and of illuminants against their codes."""
