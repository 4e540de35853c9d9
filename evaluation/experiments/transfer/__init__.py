"""Benefit of generated training images: methods are trained on them, tested on real images, and compared with baselines."""
