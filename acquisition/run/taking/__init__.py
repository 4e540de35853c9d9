"""Frames taken one behind another: which is next, its way through devices and disk, and when it counts."""
