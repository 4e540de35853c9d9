"""Whether a table may be used: figures against thresholds."""
