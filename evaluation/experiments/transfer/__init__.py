"""Benefit of generated training images: methods are trained on them, and tested on real images with baselines."""
