"""Experiments of section 4 of the paper, with the published numbers next to the results."""
