"""Loops over pixels and filters of images, compiled, in strips: what the methods are made of."""
