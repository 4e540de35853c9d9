"""Masks: weights of several illuminants in an image."""
