"""Stages of a build, from the frames of a session to a LUT."""
