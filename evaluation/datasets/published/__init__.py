"""Readers of published data sets, one file per layout: its files, and the levels and masks that are applied.

"Not verified against a real copy" marks layouts and values that were never tested on the published files.
"""
