"""Displays of uniform colours in full-screen windows."""
