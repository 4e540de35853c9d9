"""Readers of the published data sets, each file one layout: what lies where, and which levels and masks are applied.

A value that no copy of the data was at hand to hold against is said to be "not verified against a real copy".
"""
