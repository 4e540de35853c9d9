"""Checks of the print, of frames against each other, and of lights against their codes."""
