"""Checks of frames against each other and against their codes."""
