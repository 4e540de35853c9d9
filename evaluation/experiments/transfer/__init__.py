"""Benefit of generated training data: methods trained on them and tested on real images, with baselines."""
