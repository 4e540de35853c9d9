"""Loops over pixels and filters of images, compiled, in tiles: what the methods are made of."""
