"""The results of several transfers, together."""
