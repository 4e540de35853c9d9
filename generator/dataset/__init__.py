"""Datasets: read, made, stored."""
