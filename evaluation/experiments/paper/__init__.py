"""Experiments of section 4 of the CroP paper, with its published numbers next to our results."""
