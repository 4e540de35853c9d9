"""Projectors that take text commands defined by their maker, over a serial cable or TCP."""
