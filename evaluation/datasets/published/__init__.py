"""Readers of published data sets. The docstring of each module describes files, levels and masks.

"Not verified against a real copy" marks layouts and values that were never tested on the published files.
"""
